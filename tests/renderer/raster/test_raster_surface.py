"""Depth, normal and index of a frame's surface."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import renderer_of
from support.compare.images import assert_close
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import (
    front_camera,
    joined,
    one_gaussian,
    opposed_sheets,
    quad,
    random_gaussians,
    rotation,
)

CENTRE = (24, 32)


def camera() -> ls.Camera:
    """Returns a camera whose optical axis passes through the centre of pixel (24, 32)."""
    return front_camera(cx=32.5, cy=24.5)


@pytest.mark.parametrize(("opacity", "is_surface"), [(0.29, False), (0.31, True), (1.0, True)])
def test_single_gaussian_counts_as_a_surface_if_its_transmittance_is_below_0_7(
    renderer: ls.Renderer, opacity: float, is_surface: bool
) -> None:
    """The frame has one Gaussian in front of the background."""
    frame = renderer.render(ls.Scene([one_gaussian(opacity=opacity)]), camera())
    assert frame.gaussian_index[CENTRE] == (0 if is_surface else -1)
    assert frame.instance_index[CENTRE] == (0 if is_surface else -1)
    assert np.isfinite(frame.depth[CENTRE]) == is_surface
    assert np.linalg.norm(frame.normal[CENTRE]) == pytest.approx(1.0)


def test_iso_opacity_surface_is_the_layer_that_lowers_transmittance_below_the_threshold(renderer: ls.Renderer) -> None:
    """Each of several faint layers transmits 0.8; 0.8 x 0.8 < 0.7, so that the second layer is the surface."""
    layers = [one_gaussian((0.0, 0.0, 3.0 + i), 0.5, 0.2) for i in range(4)]
    frame = renderer.render(ls.Scene([joined(*reversed(layers))]), camera())
    assert frame.gaussian_index[CENTRE] == 2
    assert frame.depth[CENTRE] == pytest.approx(4.0)


@pytest.mark.parametrize("projection", [*ls.config.Projection, None], ids=["ewa", "unscented", "rays"])
@pytest.mark.parametrize(
    ("own", "instance", "gaussian"),
    [((None, None), 0, 0), ((0.3, None), 1, 0), ((0.1, 0.35), 1, 1), ((0.3, 0.1), 0, 1)],
)
def test_surface_is_the_first_gaussian_behind_which_transmittance_is_below_that_of_its_set(
    backend: str,
    own: tuple[float | None, float | None],
    instance: int,
    gaussian: int,
    projection: ls.config.Projection | None,
) -> None:
    """The layers of two sets alternate; behind them, transmittance is 0.5, 0.4, 0.2 and 0.02."""
    sets = [((3.0, 0.5), (5.0, 0.5)), ((4.0, 0.2), (6.0, 0.9))]
    splats = [
        ls.SplatInstance(
            joined(*(one_gaussian((0.0, 0.0, z), 0.5, opacity) for z, opacity in layers)), depth_iso_transmittance=iso
        )
        for layers, iso in zip(sets, own, strict=True)
    ]
    pipeline = ls.Pipeline.TRACE if projection is None else ls.Pipeline.RASTER
    raster = ls.RasterConfig(projection=projection or ls.config.Projection.EWA)
    frame = renderer_of(backend, ls.RenderConfig(pipeline=pipeline, raster=raster)).render(ls.Scene(splats), camera())
    assert (frame.instance_index[CENTRE], frame.gaussian_index[CENTRE]) == (instance, gaussian)
    assert frame.depth[CENTRE] == pytest.approx(sets[instance][gaussian][0], rel=1e-3)


@pytest.mark.parametrize(("threshold", "index"), [(1.0, 0), (0.7, 1), (0.6, 2), (0.0, -1)])
def test_higher_iso_opacity_threshold_selects_a_nearer_layer_as_the_surface(
    backend: str, threshold: float, index: int
) -> None:
    """A higher threshold selects a nearer layer."""
    layers = [one_gaussian((0.0, 0.0, 3.0 + i), 0.5, 0.2) for i in range(4)]
    config = ls.RenderConfig(raster=ls.RasterConfig(depth_iso_transmittance=threshold))
    frame = renderer_of(backend, config).render(ls.Scene([joined(*layers)]), camera())
    assert frame.gaussian_index[CENTRE] == index


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_depth_layer_is_distance_along_the_ray_and_depth_z_along_the_camera_axis(
    renderer: ls.Renderer, tilt: float
) -> None:
    """For a flat Gaussian, depth_z is that of its plane in every pixel, and depth is the distance along the ray."""
    wall = one_gaussian((0.0, 0.0, 5.0), (50.0, 50.0, 0.01), 0.9, rotation=(np.cos(tilt / 2), np.sin(tilt / 2), 0, 0))
    frame = renderer.render(ls.Scene([wall]), front_camera(cx=20.0))
    ray = oracles.pixel_rays(front_camera(cx=20.0))
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    expected = 5.0 * normal[2] / (ray @ normal)
    assert_close(frame.depth_z, expected, atol=2e-4)
    assert_close(frame.depth, expected * np.linalg.norm(ray, axis=-1), atol=3e-4)


def test_depth_of_a_round_gaussian_is_where_the_ray_is_nearest_to_its_mean(renderer: ls.Renderer) -> None:
    """The expected depth is computed from the ray and the mean of the Gaussian."""
    frame = renderer.render(ls.Scene([one_gaussian((0.3, 0.2, 5.0), 2.0, 0.9)]), camera())
    ray = oracles.pixel_rays(camera())
    expected = ray @ [0.3, 0.2, 5.0] / (ray**2).sum(axis=-1)
    seen = frame.gaussian_index >= 0
    assert seen.mean() > 0.5
    assert_close(frame.depth_z[seen], expected[seen], atol=1e-4)


def test_depth_of_a_gaussian_in_front_of_a_mesh_is_never_behind_that_mesh(renderer: ls.Renderer) -> None:
    """If a Gaussian's mean is in front of a mesh but its peak on the ray is not, the depth is that of the mesh."""
    tilted = one_gaussian((0.0, 0.0, 5.0), (2.0, 2.0, 0.01), 0.9, rotation=(np.cos(0.25), np.sin(0.25), 0.0, 0.0))
    frame = renderer.render(ls.Scene([tilted], [quad(5.1, 9.0)]), camera())
    splat = frame.gaussian_index >= 0
    assert (frame.depth_z[splat] <= 5.1001).all()
    assert 0.1 < (frame.depth_z[splat] > 5.0999).mean() < 0.6


def test_instance_index_counts_captures_then_meshes_and_gaussian_index_within_a_capture(renderer: ls.Renderer) -> None:
    """Splat instances are numbered first, then meshes; a mesh has no Gaussian index."""
    far, near = random_gaussians(90, 5, center=(0.0, 50.0, 4.0)), one_gaussian((0.5, 0.0, 3.0), 0.1, 0.9)
    target = one_gaussian((-0.5, 0.0, 3.0), 0.1, 0.9)
    scene = ls.Scene([far, joined(far, near), joined(target, far)], [quad(9.0, 0.1), quad(6.0, 5.0)])
    frame = renderer.render(scene, camera())
    assert (frame.instance_index[24, 42], frame.gaussian_index[24, 42]) == (1, 5)
    assert (frame.instance_index[24, 22], frame.gaussian_index[24, 22]) == (2, 0)
    assert (frame.instance_index[5, 32], frame.gaussian_index[5, 32]) == (4, -1)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.2, 2.8])
def test_normal_of_a_flat_gaussian_is_its_thin_axis_towards_the_viewer(renderer: ls.Renderer, angle: float) -> None:
    """The Gaussian is tilted; its normal is compared in all pixels."""
    half = 0.5 * angle
    disc = one_gaussian((0.0, 0.0, 4.0), (0.3, 0.3, 1e-4), 0.9, rotation=(np.cos(half), np.sin(half), 0.0, 0.0))
    axis = rotation((1.0, 0.0, 0.0), angle)[:3, 2]
    normal = renderer.render(ls.Scene([disc]), camera()).normal[CENTRE]
    assert normal == pytest.approx(-np.sign(axis[2]) * axis, abs=1e-3)


def test_normal_of_a_round_gaussian_points_towards_the_camera(renderer: ls.Renderer) -> None:
    """The normal points to the camera at every position and over the whole footprint."""
    mean = np.array([0.8, -0.5, 3.0])
    frame = renderer.render(ls.Scene([one_gaussian(tuple(mean), 0.2, 0.9)]), camera())
    seen = frame.alpha > 0.0
    assert_close(frame.normal[seen], np.broadcast_to(-mean / np.linalg.norm(mean), (seen.sum(), 3)), atol=1e-5)
    assert (frame.normal[~seen] == 0.0).all()


def test_normal_layer_is_the_mean_of_splat_and_mesh_normals_weighted_by_blend_weight(renderer: ls.Renderer) -> None:
    """The weights of the normals are those with which the colours are blended."""
    tilt = 0.4
    disc = one_gaussian((0.0, 0.0, 4.0), (0.3, 0.3, 1e-4), 0.6, rotation=(np.cos(tilt / 2), np.sin(tilt / 2), 0.0, 0.0))
    frame = renderer.render(ls.Scene([disc], [quad(5.0, tilt=0.5)]), camera())
    disc_normal = -rotation((1.0, 0.0, 0.0), tilt)[:3, 2]
    mesh_normal = np.array([0.5, 0.0, -1.0]) / np.hypot(0.5, 1.0)
    mixed = 0.6 * disc_normal + 0.4 * mesh_normal
    assert frame.normal[CENTRE] == pytest.approx(mixed / np.linalg.norm(mixed), abs=1e-3)


def test_opposite_normals_that_cancel_in_a_pixel_become_the_direction_to_the_camera(renderer: ls.Renderer) -> None:
    """Two sheets of opposite normals cancel; either sheet alone keeps its normal."""
    sheets = opposed_sheets()
    frame = renderer.render(ls.Scene([sheets]), camera())
    assert frame.normal[CENTRE] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
    above = renderer.render(ls.Scene([sheets]), camera()).normal[14, 32]
    ray = oracles.pixel_rays(camera())[14, 32]
    assert above == pytest.approx(-ray / np.linalg.norm(ray), abs=1e-5)
    alone = renderer.render(ls.Scene([sheets.subset(np.array([0]))]), camera())
    assert abs(alone.normal[CENTRE][0]) > 0.99
