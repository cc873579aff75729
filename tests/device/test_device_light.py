"""Tests of light samples at a point: closed forms, geometry, and irradiance of soft lights by quadrature."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from lumisplat.device.light.light import (
    LIGHT_DIRECTIONAL,
    LIGHT_DISK,
    LIGHT_ENVIRONMENT,
    LIGHT_HEADLIGHT,
    LIGHT_POINT,
    LIGHT_RECT,
    LIGHT_SPOT,
)
from lumisplat.device.structs.shading import LightCrossing, LightData, LightSample
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.oracles.light_oracle import Array, cap, cone, first_hit, polygon_irradiance, window
from support.probes import probe_light_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
POSITION = (1.0, 2.0, -0.5)
AXIS = np.array([2.0, -6.0, 3.0]) / 7.0
ACROSS = np.array([3.0, 2.0, 2.0]) / math.sqrt(17.0)  # perpendicular to the axis
KINDS = (LIGHT_POINT, LIGHT_SPOT, LIGHT_DIRECTIONAL, LIGHT_RECT, LIGHT_DISK, LIGHT_HEADLIGHT, LIGHT_ENVIRONMENT)


def light(kind: Any, **values: Any) -> npt.NDArray[Any]:
    """Returns a row of ``LightData``, by default of power (3, 2, 1) in candela, lux or radiance and infinite range."""
    table = np.zeros(1, dtype=table_dtype(LightData))
    if kind == LIGHT_RECT:
        values.setdefault("direction", np.cross(values["edge_u"], values["edge_v"]))
        values["direction"] = values["direction"] / np.linalg.norm(values["direction"])
    for name in ("inner", "outer"):
        if name in values:
            values[name] = 2.0 * math.sin(0.5 * values[name]) ** 2
    defaults = {"kind": kind, "power": (3.0, 2.0, 1.0), "position": POSITION, "direction": AXIS, "range": math.inf}
    for name, value in (defaults | values).items():
        table[name] = value
    return table


def sample_lights(
    lights: npt.NDArray[Any], points: npt.ArrayLike, soft: bool = False, u: Array | None = None, device: str = "cpu"
) -> Any:
    """Samples one light, or one light per point, from ``points``; returns a structured array of ``LightSample``."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    count = max(len(points), 1 if u is None else len(u))
    u = np.zeros((count, 2)) if u is None else u
    inputs = (
        wp.array(np.ascontiguousarray(np.broadcast_to(lights, count)), dtype=LightData, device=device),
        wp.array(np.broadcast_to(points, (count, 3)).astype(np.float32), dtype=wp.vec3, device=device),
        int(soft),
        wp.array(np.asarray(u, dtype=np.float32), dtype=wp.vec2, device=device),
    )
    samples = wp.zeros(count, dtype=LightSample, device=device)
    Launcher(device, threads=1).run(probe_light_kernels.probe_lights, count, *inputs, samples)
    return samples.numpy()


def intersect(table: npt.NDArray[Any], origin: Array, directions: npt.NDArray[Any]) -> Any:
    """Intersects rays from one origin with a light; returns a structured array of ``LightCrossing``."""
    vectors = wp.array(directions.astype(np.float32), dtype=wp.vec3, device="cpu")
    crossings = wp.zeros(len(directions), dtype=LightCrossing, device="cpu")
    inputs = wp.array(table, dtype=LightData, device="cpu"), wp.vec3(*origin), vectors
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_crossings, len(directions), *inputs, crossings)
    return crossings.numpy()


def grid(steps: int) -> Array:
    """Returns stratified numbers in place of random ones: the centres of grid cells, shape (steps^2, 2)."""
    centers = (np.arange(steps) + 0.5) / steps
    return np.stack(np.meshgrid(centers, centers, indexing="ij"), axis=-1).reshape(-1, 2)


def mean_irradiance(samples: Any, normal: Array) -> Array:
    """Returns the mean irradiance, shape (3,), that light samples give a surface with the given normal."""
    cosines = np.maximum(samples["direction"].astype(np.float64) @ normal, 0.0)
    return (samples["irradiance"] * cosines[:, None]).mean(axis=0)


# --- Closed forms ---


def test_point_light_samples_follow_the_inverse_square_law() -> None:
    """8 candela give 2 lux at 2 units and 32 lux at 0.5 units."""
    table = light(LIGHT_POINT, power=(8.0, 4.0, 0.0))
    samples = sample_lights(table, [(1.0, 0.0, -0.5), (1.0, 2.0, 0.0)])
    np.testing.assert_allclose(samples["irradiance"], [(2.0, 1.0, 0.0), (32.0, 16.0, 0.0)], rtol=1e-6)
    np.testing.assert_allclose(samples["direction"], [(0.0, 1.0, 0.0), (0.0, 0.0, -1.0)], atol=1e-7)
    np.testing.assert_allclose(samples["distance"], (2.0, 0.5), rtol=1e-6)
    assert not samples["pdf"].any()


def test_range_window_of_a_point_light_matches_the_closed_form() -> None:
    """The window is 15/16 at half the range, 0.3439 at 0.9 times the range, and 0 from the range on."""
    table = light(LIGHT_POINT, range=4.0, position=(0.0, 0.0, 0.0), power=(16.0, 16.0, 16.0))
    samples = sample_lights(table, [(2.0, 0.0, 0.0), (3.6, 0.0, 0.0), (4.0, 0.0, 0.0), (9.0, 0.0, 0.0)])
    np.testing.assert_allclose(samples["irradiance"][:, 0], (3.75, 0.3439 * 16.0 / 12.96, 0.0, 0.0), rtol=1e-5)
    assert window(2.0, 4.0) == 0.9375


def test_cone_falloff_of_a_spot_light_matches_the_closed_form() -> None:
    """A cone from 30 to 60 degrees is 1 at 20 degrees, 0.56580^2 at 45, and 0 at 61 and behind the light."""
    table = light(
        LIGHT_SPOT, direction=(0.0, -1.0, 0.0), position=(0.0, 0.0, 0.0), inner=math.pi / 6, outer=math.pi / 3
    )
    angles = np.radians([0.0, 20.0, 45.0, 61.0, 180.0])
    points = np.stack([np.sin(angles), -np.cos(angles), 0.0 * angles], axis=1)
    expected = np.array([1.0, 1.0, 0.32013, 0.0, 0.0])
    np.testing.assert_allclose(sample_lights(table, points)["irradiance"][:, 0], 3.0 * expected, rtol=1e-4)
    np.testing.assert_allclose(cone(angles, math.pi / 6, math.pi / 3), expected, rtol=1e-4)


@pytest.mark.parametrize("outer", [1e-4, 1e-3, 0.1, math.pi / 2.0])
def test_narrow_spot_light_cones_keep_float32_precision(outer: float) -> None:
    """A cone of 1e-4 radians fades as a wide cone does."""
    table = light(LIGHT_SPOT, position=(0.0, 0.0, 0.0), inner=0.5 * outer, outer=outer)
    angles = outer * np.linspace(0.0, 1.1, 23)
    points = np.cos(angles)[:, None] * AXIS + np.sin(angles)[:, None] * ACROSS
    # The tolerance covers the rounding of the points to float32.
    expected = 3.0 * cone(angles, 0.5 * outer, outer)
    np.testing.assert_allclose(sample_lights(table, points)["irradiance"][:, 0], expected, atol=1e-5 + 6e-7 / outer)


def test_spot_light_with_equal_cone_angles_has_a_sharp_edge() -> None:
    """Inner and outer angles that are equal in float32 cause no division by zero."""
    table = light(LIGHT_SPOT, position=(0.0, 0.0, 0.0), inner=0.5, outer=math.nextafter(0.5, 1.0))
    angles = np.array([0.49, 0.51])
    points = np.cos(angles)[:, None] * AXIS + np.sin(angles)[:, None] * ACROSS
    np.testing.assert_allclose(sample_lights(table, points)["irradiance"][:, 0], (3.0, 0.0), rtol=1e-5)
    table = light(
        LIGHT_SPOT, position=(0.0, 0.0, 0.0), direction=(0.0, 0.0, -1.0), inner=math.pi / 2, outer=math.pi / 2
    )
    assert sample_lights(table, (1.0, 0.0, 0.0))["irradiance"][0, 0] in (0.0, 3.0)  # on the edge


def test_directional_light_and_headlight_do_not_fall_off_with_distance() -> None:
    """The irradiance is the same at every point; a directional light is infinitely far, a headlight at the eye."""
    points = [(0.0, 0.0, 0.0), (1.0, 2.0, 3.5)]
    samples = sample_lights(light(LIGHT_DIRECTIONAL), points)
    np.testing.assert_allclose(samples["direction"], np.tile(-AXIS, (2, 1)), atol=1e-7)
    np.testing.assert_array_equal(samples["irradiance"], [(3.0, 2.0, 1.0)] * 2)
    assert np.isinf(samples["distance"]).all()
    samples = sample_lights(light(LIGHT_HEADLIGHT), points)
    np.testing.assert_allclose(samples["direction"][1], (0.0, 0.0, -1.0), atol=1e-7)
    np.testing.assert_array_equal(samples["irradiance"], [(3.0, 2.0, 1.0)] * 2)
    np.testing.assert_allclose(samples["distance"], (math.sqrt(5.25), 4.0), rtol=1e-6)


def test_rectangle_light_without_soft_shadows_matches_its_closed_form_irradiance() -> None:
    """Area 6 at 6 units gives radiance times 6 / 36, half of it at 60 degrees, 0 behind, at most radiance times pi."""
    table = light(LIGHT_RECT, position=(0.0, 6.0, 0.0), edge_u=(2.0, 0.0, 0.0), edge_v=(0.0, 0.0, 3.0))
    np.testing.assert_allclose(table["direction"][0], (0.0, -1.0, 0.0))
    slanted = (6.0 * math.sin(math.pi / 3), 6.0 - 6.0 * math.cos(math.pi / 3), 0.0)
    samples = sample_lights(table, [(0.0, 0.0, 0.0), slanted, (0.0, 7.0, 0.0), (1.0, 6.0, 0.0), (0.0, 5.9, 0.0)])
    expected = 3.0 * np.array([1.0 / 6.0, 1.0 / 12.0, 0.0, 0.0, math.pi])
    np.testing.assert_allclose(samples["irradiance"][:, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(samples["distance"][:2], 6.0, rtol=1e-6)
    assert not samples["pdf"].any()


def test_samples_of_a_light_without_soft_shadows_ignore_its_extent() -> None:
    """Radius, angular radius and random numbers affect soft lights only."""
    for kind in (LIGHT_POINT, LIGHT_SPOT, LIGHT_DIRECTIONAL):
        sharp, wide = (light(kind, radius=radius, inner=0.1, outer=1.0) for radius in (0.0, 0.7))
        for u in ((0.0, 0.0), (0.3, 0.8)):
            samples = [sample_lights(which, (0.4, 3.0, 0.1), u=np.array([u])) for which in (sharp, wide)]
            assert samples[0] == samples[1]
        assert sample_lights(sharp, (0.4, 3.0, 0.1)) == sample_lights(sharp, (0.4, 3.0, 0.1), soft=True)


def test_sample_light_returns_zero_irradiance_for_environments() -> None:
    """Environments have their own sampling function, so ``sample_light`` returns irradiance 0 for them."""
    assert not sample_lights(light(LIGHT_ENVIRONMENT), (0.0, 0.0, 0.0), soft=True)["irradiance"].any()


# --- Geometry ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("ratio", [1e-5, 1e-3, 0.05, 0.5, 0.9, 0.999])
def test_sphere_light_samples_end_on_the_near_side_of_the_sphere(ratio: float, device: str) -> None:
    """Each sample has the pdf 1 / solid angle, and the irradiance that the radiance of the sphere gives."""
    rng = np.random.default_rng(2)
    distance = 3.0
    point = np.array(POSITION) + distance * AXIS
    radius = ratio * distance
    samples = sample_lights(light(LIGHT_POINT, radius=radius), point, True, rng.random((5000, 2)), device)
    directions = samples["direction"].astype(np.float64)
    assert not np.isnan(first_hit(point, directions, np.array(POSITION), radius + 1e-6 * distance)).any()
    # The samples end at one radius from the centre, on the near side.
    ends = point + samples["distance"][:, None].astype(np.float64) * directions - np.array(POSITION)
    np.testing.assert_allclose(np.linalg.norm(ends, axis=1), radius, atol=1e-6 * distance)
    assert (ends @ AXIS > -1e-6 * distance).all()
    middle = np.abs(first_hit(point, directions, np.array(POSITION), radius) - samples["distance"])
    assert np.nanmedian(middle) < 1e-6 * distance
    size = cap(math.asin(ratio))
    np.testing.assert_allclose(samples["pdf"], 1.0 / size, rtol=2e-3 if ratio > 0.99 else 1e-4)
    radiance = np.array([3.0, 2.0, 1.0]) / (math.pi * radius**2)
    expected = np.tile(radiance * size, (5000, 1))
    np.testing.assert_allclose(samples["irradiance"], expected, rtol=2e-3 if ratio > 0.99 else 1e-4)


@pytest.mark.parametrize("tilt", [0.0, 0.4])
@pytest.mark.parametrize("ratio", [1e-5, 1e-3, 0.05, 0.5, 0.9])
def test_irradiance_of_a_sphere_light_equals_that_of_a_point_light_at_the_spheres_centre(
    ratio: float, tilt: float
) -> None:
    """A sphere wholly above the horizon gives candela / distance^2 times the cosine of its centre's direction."""
    point = np.array(POSITION) + 3.0 * AXIS
    normal = -math.cos(tilt) * AXIS + math.sin(tilt) * ACROSS
    samples = sample_lights(light(LIGHT_POINT, radius=3.0 * ratio), point, True, grid(256))
    expected = np.array([3.0, 2.0, 1.0]) / 9.0 * math.cos(tilt)
    if math.asin(ratio) + tilt > math.pi / 2.0:
        pytest.skip("partly below the horizon")
    np.testing.assert_allclose(mean_irradiance(samples, normal), expected, rtol=1e-4)


def test_range_and_cone_attenuation_of_a_spot_light_with_radius_apply_at_its_centre() -> None:
    """Range window and cone of a spot with a radius are evaluated at the centre."""
    table = light(LIGHT_SPOT, radius=0.3, inner=0.2, outer=0.5, range=4.0)
    angle = 0.35
    direction = math.cos(angle) * AXIS + math.sin(angle) * ACROSS
    point = np.array(POSITION) + 3.0 * direction
    expected = 3.0 / 9.0 * float(cone(angle, 0.2, 0.5) * window(3.0, 4.0))
    assert mean_irradiance(sample_lights(table, point, True, grid(128)), -direction)[0] == pytest.approx(
        expected, rel=1e-3
    )


@pytest.mark.parametrize("share", [0.0, 1e-8, 0.3, 0.999, 1.001])
def test_sphere_light_irradiance_is_continuous_at_the_surface_of_the_sphere(share: float) -> None:
    """Points inside the sphere receive the irradiance of the surface; the centre gives finite values."""
    point = np.array(POSITION) + share * 0.5 * AXIS
    samples = sample_lights(light(LIGHT_POINT, radius=0.5), point, True, grid(64))
    if share > 1e-6:
        assert mean_irradiance(samples, -AXIS)[0] == pytest.approx(3.0 / 0.25, rel=3e-3)
    assert np.isfinite(samples["irradiance"]).all()


@pytest.mark.parametrize("angle", [1e-4, 0.00465, 0.1, 1.0, math.pi / 2.0])
def test_soft_directional_light_samples_are_uniform_in_its_angular_radius(angle: float) -> None:
    """A facing surface receives the lux of the light, and directions are uniform over the light's cone."""
    samples = sample_lights(light(LIGHT_DIRECTIONAL, radius=angle), (0.0, 0.0, 0.0), True, grid(256))
    np.testing.assert_allclose(mean_irradiance(samples, -AXIS), (3.0, 2.0, 1.0), rtol=1e-4)
    off = np.linalg.norm(samples["direction"] + AXIS, axis=1)  # chord
    assert off.max() <= 2.0 * math.sin(0.5 * angle) + 3e-7
    # Uniform directions have a uniform squared chord.
    assert np.mean(off**2) == pytest.approx(2.0 * math.sin(0.5 * angle) ** 2, rel=1e-2)
    mean = samples["direction"].mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(mean @ np.array([AXIS, ACROSS, np.cross(AXIS, ACROSS)]).T[:, 1:], 0.0, atol=2e-5)
    np.testing.assert_allclose(samples["pdf"], 1.0 / cap(angle), rtol=1e-4)
    assert np.isinf(samples["distance"]).all()


@pytest.mark.parametrize("seed", range(6))
def test_rectangle_light_samples_match_lamberts_polygon_formula(seed: int) -> None:
    """The irradiance of a parallelogram matches Lambert's polygon formula; its samples cover its area."""
    rng = np.random.default_rng(seed)
    position = np.array([0.0, 0.0, 2.0]) + 0.3 * rng.normal(size=3)
    edge_u, edge_v = np.array([0.0, 1.2, 0.0]) + 0.2 * rng.normal(size=3), np.array([0.8, 0.0, 0.0])
    normal = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    corners = np.array(
        [position + a * edge_u + b * edge_v for a, b in ((-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5))]
    )
    assert (corners @ normal > 0.0).all()
    table = light(LIGHT_RECT, position=position, edge_u=edge_u, edge_v=edge_v)
    samples = sample_lights(table, (0.0, 0.0, 0.0), True, grid(128))
    expected = abs(polygon_irradiance(corners, np.zeros(3), normal))
    np.testing.assert_allclose(mean_irradiance(samples, normal), expected * np.array([3.0, 2.0, 1.0]), rtol=2e-4)
    # The samples lie on the rectangle, with the pdf of its solid angle.
    u = grid(128) - 0.5
    points = position + u[:, :1] * edge_u + u[:, 1:] * edge_v
    np.testing.assert_allclose(samples["distance"][:, None] * samples["direction"], points, atol=1e-5)
    np.testing.assert_allclose(samples["irradiance"][:, 0] * samples["pdf"], 3.0, rtol=1e-5)
    # The back of the light emits nothing.
    behind = sample_lights(table, 2.0 * position, True, grid(4))
    assert not behind["irradiance"].any()


@pytest.mark.parametrize("seed", range(4))
def test_disk_light_samples_match_lamberts_polygon_formula(seed: int) -> None:
    """The irradiance of a disk matches Lambert's formula for a polygon of 4000 corners; samples are uniform in area."""
    rng = np.random.default_rng(seed)
    position, axis = np.array([0.0, 0.0, 2.0]) + 0.3 * rng.normal(size=3), np.array([0.0, 0.0, -1.0])
    axis = axis + 0.3 * rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    normal = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    u = np.cross(axis, (1.0, 0.0, 0.0))
    u /= np.linalg.norm(u)
    v, azimuth = np.cross(axis, u), 2.0 * np.pi * np.arange(4000)[:, None] / 4000
    corners = position + 0.7 * (np.cos(azimuth) * u + np.sin(azimuth) * v)
    assert (corners @ normal > 0.0).all()
    table = light(LIGHT_DISK, position=position, direction=axis, radius=0.7)
    samples = sample_lights(table, (0.0, 0.0, 0.0), True, grid(128))
    expected = abs(polygon_irradiance(corners, np.zeros(3), normal))
    np.testing.assert_allclose(mean_irradiance(samples, normal), expected * np.array([3.0, 2.0, 1.0]), rtol=2e-4)
    np.testing.assert_allclose(samples["irradiance"][:, 0] * samples["pdf"], 3.0, rtol=1e-5)
    offsets = samples["distance"][:, None] * samples["direction"].astype(np.float64) - position
    np.testing.assert_allclose(offsets @ axis, 0.0, atol=2e-6)
    shares = (offsets**2).sum(axis=1) / 0.49
    np.testing.assert_allclose(np.quantile(shares, (0.25, 0.5, 0.75, 1.0)), (0.25, 0.5, 0.75, 1.0), atol=0.01)
    np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=1e-5)
    assert not sample_lights(table, position - 0.1 * axis, True, grid(4))["irradiance"].any()


@pytest.mark.parametrize("height", [0.05, 0.7, 20.0])
def test_irradiance_on_the_axis_of_a_disk_light_matches_the_closed_form(height: float) -> None:
    """A soft disk gives radiance times pi r^2 / (r^2 + h^2), a hard one pi r^2 / h^2 and at most pi."""
    table = light(LIGHT_DISK, position=(0.0, height, 0.0), direction=(0.0, -1.0, 0.0), radius=0.7)
    up = np.array([0.0, 1.0, 0.0])
    radii2 = np.stack([(np.arange(20000) + 0.5) / 20000, np.full(20000, 0.3)], axis=1)
    soft = mean_irradiance(sample_lights(table, (0.0, 0.0, 0.0), True, radii2), up)
    assert soft[0] == pytest.approx(3.0 * math.pi * 0.49 / (0.49 + height**2), rel=1e-3)
    hard = mean_irradiance(sample_lights(table, (0.0, 0.0, 0.0)), up)
    assert hard[0] == pytest.approx(3.0 * math.pi * min(0.49 / height**2, 1.0), rel=1e-5)


FLAT = {
    LIGHT_RECT: {"edge_u": (0.9, 0.1, 0.0), "edge_v": (0.0, 0.2, 1.1)},
    LIGHT_DISK: {"radius": 0.6},
    LIGHT_POINT: {"radius": 0.6},
}


@pytest.mark.parametrize("kind", FLAT)
def test_rays_that_hit_a_light_have_the_distance_and_pdf_of_samples_of_that_light(kind: Any) -> None:
    """Distance and pdf of the intersection equal those of the sample; the pdf integrates to 1 over the sphere."""
    table = light(kind, **FLAT[kind])
    towards = table["direction"][0].astype(np.float64)
    point = np.array(POSITION) + 1.3 * towards + 0.4 * np.cross(towards, (1.0, 0.0, 0.0))
    samples = sample_lights(table, point, True, np.clip(grid(40), 0.001, 0.999))
    crossings = intersect(table, point, samples["direction"])
    assert np.isfinite(crossings["t"]).all()
    np.testing.assert_allclose(crossings["t"], samples["distance"], rtol=1e-3 if kind == LIGHT_POINT else 1e-5)
    np.testing.assert_allclose(crossings["pdf"], samples["pdf"], rtol=1e-4)
    cells = grid(1200)
    height, azimuth = 2.0 * cells[:, 0] - 1.0, 2.0 * math.pi * cells[:, 1]
    around = np.stack(
        [np.sqrt(1.0 - height**2) * np.cos(azimuth), height, np.sqrt(1.0 - height**2) * np.sin(azimuth)], axis=1
    )
    pdfs = intersect(table, point, around)["pdf"].astype(np.float64)
    assert 4.0 * math.pi * pdfs.mean() == pytest.approx(1.0, rel=3e-3)
    assert np.isinf(intersect(table, point, -samples["direction"])["t"]).all()


def test_lambert_polygon_oracle_matches_the_closed_form_of_a_disk() -> None:
    """A disk on the axis gives pi times the squared sine of its angular radius."""
    azimuth = 2.0 * np.pi * np.arange(4000) / 4000
    corners = np.stack([0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), np.ones(4000)], axis=1)
    disc = polygon_irradiance(corners, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert abs(disc) == pytest.approx(math.pi * 0.49 / 1.49, rel=1e-5)


# --- Extreme values ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_light_samples_are_finite_for_extreme_values(kind: Any, soft: bool, device: str) -> None:
    """Samples stay finite at, next to and far from lights of any size and power."""
    offsets = [0.0, 1e-30, 1e-18, 1e-9, 1e-4, 1.0, 1e9, 1e18]
    points = np.array([(sign * x, y, 0.0) for x in offsets for y in offsets for sign in (-1.0, 1.0)])
    for size in (0.0, 1e-20, 1e-5, 1.0, 1e18):
        for power in (0.0, 1e-30, 1.0, 1e30):
            for reach in (1e-30, 1.0, math.inf):
                table = light(
                    kind,
                    position=(0.0, 0.0, 0.0),
                    power=(power, power, power),
                    radius=min(size, math.pi / 2.0) if kind == LIGHT_DIRECTIONAL else size,
                    direction=(0.0, -1.0, 0.0),
                    edge_u=(size, 0.0, 0.0),
                    edge_v=(0.0, 0.0, size),
                    inner=0.0,
                    outer=1e-3,
                    range=reach,
                )
                for u in ((0.0, 0.0), (0.5, 0.5), (1.0, 1.0)):
                    samples = sample_lights(table, points, soft, np.tile(np.array([u]), (len(points), 1)), device)
                    for name in ("direction", "irradiance", "pdf"):
                        assert np.isfinite(samples[name]).all(), (name, size, power, reach, u)
                    assert not np.isnan(samples["distance"]).any()
                    assert (samples["distance"] >= 0.0).all()
                    assert (samples["irradiance"] >= 0.0).all()
                    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0, atol=1e-5)
