"""Tests of blending, pixel rays and triangle setup, called from Python."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings, strategies as st

from lumisplat.device.math.color import encode_srgb
from lumisplat.device.mesh.triangle_raster import barycentric, setup_triangle
from lumisplat.device.splat.blending import blend, empty_pixel, pixel_ray
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import BlendState, Splat
from lumisplat.math.color import encode_srgb as encode_srgb_host
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import front_camera

unit = st.floats(-1.0, 1.0)
points = st.tuples(unit, unit, st.floats(0.5, 3.0))


def blended(alphas: list[float], transmittance_min: float = 1e-4, iso: float = 0.7) -> BlendState:
    """Returns a pixel after blending splats with the given alphas; splat i has colour (i, 1, 0)."""
    pixel = empty_pixel()
    for i, alpha in enumerate(alphas):
        splat = Splat()
        splat.color = wp.vec3(float(i), 1.0, 0.0)
        splat.normal = wp.vec3(0.0, 0.0, 1.0)
        splat.index = i
        if pixel.transmittance > 0.0:
            pixel = blend(pixel, splat, alpha, transmittance_min, iso)
    return pixel


@given(st.lists(st.floats(0.0, 0.99), max_size=12))
def test_blend_weights_and_transmittance_of_a_pixel_sum_to_one(alphas: list[float]) -> None:
    """The transmittance also stays above its minimum."""
    pixel = blended(alphas)
    green = np.array(pixel.color)[1]
    assert green + abs(pixel.transmittance) == pytest.approx(1.0, abs=1e-5)
    assert pixel.normal[2] == pytest.approx(green, abs=1e-6)
    assert abs(pixel.transmittance) > 1e-4


@given(st.lists(st.floats(0.0, 0.99), max_size=12), st.floats(0.0, 1.0))
def test_iso_opacity_surface_is_the_first_splat_with_transmittance_below_the_threshold(
    alphas: list[float], iso: float
) -> None:
    """The surface is the first blended splat after which the transmittance is below the threshold, or -1."""
    pixel = blended(alphas, iso=iso)
    remaining, expected, first = np.float32(1.0), -1, -1
    for i, alpha in enumerate(alphas):
        after = remaining - remaining * np.float32(alpha)
        if after <= np.float32(1e-4):
            break
        if abs(after - iso) < 1e-6:
            return  # Rounding may decide.
        if after < iso and expected < 0:
            expected = i
        first = i if first < 0 else first
        remaining = after
    assert (pixel.surface, pixel.first) == (expected, first)


def test_blending_stops_a_pixel_at_minimum_transmittance_and_marks_it_by_a_minus_sign() -> None:
    """The splat that would bring the transmittance below its minimum is dropped."""
    pixel = blended([0.9, 0.9, 0.99, 0.5])
    assert pixel.transmittance == pytest.approx(-0.01, rel=1e-4)
    assert pixel.color[0] == pytest.approx(0.09, rel=1e-4)


def test_rasteriser_pixel_rays_pass_through_the_pixel_centres() -> None:
    """Rays have z = 1 and project to the pixel's index plus 0.5."""
    camera = front_camera(cx=20.3, cy=31.7, fx=50.0, fy=75.0)
    data = CameraData()
    data.focal, data.raster_center = wp.vec2(50.0, 75.0), wp.vec2(20.3, 31.7)
    rays = oracles.pixel_rays(camera)
    for y, x in ((0, 0), (47, 63), (13, 5)):
        np.testing.assert_allclose(np.array(pixel_ray(data, x, y)), rays[y, x], atol=1e-6)
        assert rays[y, x, 0] * 50.0 + 20.3 == pytest.approx(x + 0.5)
        assert rays[y, x, 1] * 75.0 + 31.7 == pytest.approx(y + 0.5)


@settings(max_examples=60)
@given(points, points, points, st.tuples(*[st.floats(0.02, 1.0)] * 3))
def test_barycentric_coordinates_of_a_ray_recover_its_point_on_the_triangle(
    v0: tuple[float, ...], v1: tuple[float, ...], v2: tuple[float, ...], mix: tuple[float, ...]
) -> None:
    """A ray at a point of the triangle returns its barycentric coordinates and depth for both windings."""
    corners = np.array([v0, v1, v2])
    if abs(corners[0] @ np.cross(corners[1], corners[2])) < 1e-2:
        return
    weights = np.array(mix) / np.sum(mix)
    point = weights @ corners
    ray = wp.vec3(*(point / point[2]))
    for order in ([0, 1, 2], [0, 2, 1]):
        triangle = setup_triangle(*(wp.vec3(*corners[i]) for i in order))
        edges = np.array([triangle.edge0, triangle.edge1, triangle.edge2]) @ np.array(ray)
        assert (edges > 0.0).all() or (edges < 0.0).all()
        assert triangle.plane / (np.array(triangle.normal) @ np.array(ray)) == pytest.approx(point[2], rel=1e-3)
        np.testing.assert_allclose(np.array(barycentric(triangle, ray)), weights[order], atol=2e-3)


@settings(max_examples=60)
@given(points, points)
def test_shared_edges_of_two_triangles_have_opposite_edge_functions(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    """Two triangles that share an edge compute edge functions of opposite sign and equal bits."""
    outer = wp.vec3(-3.0, 2.0, 1.0), wp.vec3(3.0, -2.0, 1.5)
    one = setup_triangle(outer[0], wp.vec3(*a), wp.vec3(*b))
    two = setup_triangle(outer[1], wp.vec3(*b), wp.vec3(*a))
    first, second = np.array(one.edge0), np.array(two.edge0)
    np.testing.assert_array_equal(first, -second)


@given(st.floats(0.0, 4.0))
def test_device_srgb_encoding_matches_the_host(value: float) -> None:
    """Device and host agree for values from 0 to 4."""
    assert encode_srgb(value) == pytest.approx(float(encode_srgb_host(np.float64(value))), abs=1e-5)
