"""Lights as a point sees them: by hand, against geometry, and soft ones against what all of their extent gives."""

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
ACROSS = np.array([3.0, 2.0, 2.0]) / math.sqrt(17.0)  # square to the axis
KINDS = (LIGHT_POINT, LIGHT_SPOT, LIGHT_DIRECTIONAL, LIGHT_RECT, LIGHT_DISK, LIGHT_HEADLIGHT, LIGHT_ENVIRONMENT)


def light(kind: Any, **values: Any) -> npt.NDArray[Any]:
    """A row as kernels read it: 3, 2 and 1 candela, lux or units of radiance, without end, unless given."""
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


def seen(
    lights: npt.NDArray[Any], points: npt.ArrayLike, soft: bool = False, u: Array | None = None, device: str = "cpu"
) -> Any:
    """Samples of a light, or of one a point, as a structured array."""
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


def crossed(there: npt.NDArray[Any], origin: Array, directions: npt.NDArray[Any]) -> Any:
    """Where rays from a point cross a light, as a structured array."""
    ways = wp.array(directions.astype(np.float32), dtype=wp.vec3, device="cpu")
    crossings = wp.zeros(len(directions), dtype=LightCrossing, device="cpu")
    inputs = wp.array(there, dtype=LightData, device="cpu"), wp.vec3(*origin), ways
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_crossings, len(directions), *inputs, crossings)
    return crossings.numpy()


def grid(steps: int) -> Array:
    """Random numbers without the randomness: centers of cells, shape (steps^2, 2)."""
    centers = (np.arange(steps) + 0.5) / steps
    return np.stack(np.meshgrid(centers, centers, indexing="ij"), axis=-1).reshape(-1, 2)


def gathered(samples: Any, normal: Array) -> Array:
    """Mean irradiance of a surface with that normal."""
    cosines = np.maximum(samples["direction"].astype(np.float64) @ normal, 0.0)
    return (samples["irradiance"] * cosines[:, None]).mean(axis=0)


# --- By hand ---


def test_inverse_square() -> None:
    """8 candela at 2 units are 2 lux, at 0.5 units 32; the light is where it is."""
    there = light(LIGHT_POINT, power=(8.0, 4.0, 0.0))
    samples = seen(there, [(1.0, 0.0, -0.5), (1.0, 2.0, 0.0)])
    np.testing.assert_allclose(samples["irradiance"], [(2.0, 1.0, 0.0), (32.0, 16.0, 0.0)], rtol=1e-6)
    np.testing.assert_allclose(samples["direction"], [(0.0, 1.0, 0.0), (0.0, 0.0, -1.0)], atol=1e-7)
    np.testing.assert_allclose(samples["distance"], (2.0, 0.5), rtol=1e-6)
    assert not samples["pdf"].any()


def test_range() -> None:
    """At half the range 15/16 are left, at 0.9 of it 0.3439, at the range and behind nothing."""
    there = light(LIGHT_POINT, range=4.0, position=(0.0, 0.0, 0.0), power=(16.0, 16.0, 16.0))
    samples = seen(there, [(2.0, 0.0, 0.0), (3.6, 0.0, 0.0), (4.0, 0.0, 0.0), (9.0, 0.0, 0.0)])
    np.testing.assert_allclose(samples["irradiance"][:, 0], (3.75, 0.3439 * 16.0 / 12.96, 0.0, 0.0), rtol=1e-5)
    assert window(2.0, 4.0) == 0.9375


def test_cone() -> None:
    """From 30 to 60 degrees: all at 20, at 45 the square of 0.56580, nothing at 61 and behind."""
    there = light(
        LIGHT_SPOT, direction=(0.0, -1.0, 0.0), position=(0.0, 0.0, 0.0), inner=math.pi / 6, outer=math.pi / 3
    )
    angles = np.radians([0.0, 20.0, 45.0, 61.0, 180.0])
    points = np.stack([np.sin(angles), -np.cos(angles), 0.0 * angles], axis=1)
    expected = np.array([1.0, 1.0, 0.32013, 0.0, 0.0])
    np.testing.assert_allclose(seen(there, points)["irradiance"][:, 0], 3.0 * expected, rtol=1e-4)
    np.testing.assert_allclose(cone(angles, math.pi / 6, math.pi / 3), expected, rtol=1e-4)


@pytest.mark.parametrize("outer", [1e-4, 1e-3, 0.1, math.pi / 2.0])
def test_small_cones(outer: float) -> None:
    """A spot no wider than a laser's beam fades as a wide one does."""
    there = light(LIGHT_SPOT, position=(0.0, 0.0, 0.0), inner=0.5 * outer, outer=outer)
    angles = outer * np.linspace(0.0, 1.1, 23)
    points = np.cos(angles)[:, None] * AXIS + np.sin(angles)[:, None] * ACROSS
    # Points in float32 are off by as much as their last digit.
    expected = 3.0 * cone(angles, 0.5 * outer, outer)
    np.testing.assert_allclose(seen(there, points)["irradiance"][:, 0], expected, atol=1e-5 + 6e-7 / outer)


def test_cones_without_a_fade() -> None:
    """Angles that float32 cannot tell apart make a sharp edge."""
    there = light(LIGHT_SPOT, position=(0.0, 0.0, 0.0), inner=0.5, outer=math.nextafter(0.5, 1.0))
    angles = np.array([0.49, 0.51])
    points = np.cos(angles)[:, None] * AXIS + np.sin(angles)[:, None] * ACROSS
    np.testing.assert_allclose(seen(there, points)["irradiance"][:, 0], (3.0, 0.0), rtol=1e-5)
    there = light(
        LIGHT_SPOT, position=(0.0, 0.0, 0.0), direction=(0.0, 0.0, -1.0), inner=math.pi / 2, outer=math.pi / 2
    )
    assert seen(there, (1.0, 0.0, 0.0))["irradiance"][0, 0] in (0.0, 3.0)  # on the edge


def test_directional_and_headlight() -> None:
    """As bright everywhere, from infinitely far away, and from the eye."""
    points = [(0.0, 0.0, 0.0), (1.0, 2.0, 3.5)]
    samples = seen(light(LIGHT_DIRECTIONAL), points)
    np.testing.assert_allclose(samples["direction"], np.tile(-AXIS, (2, 1)), atol=1e-7)
    np.testing.assert_array_equal(samples["irradiance"], [(3.0, 2.0, 1.0)] * 2)
    assert np.isinf(samples["distance"]).all()
    samples = seen(light(LIGHT_HEADLIGHT), points)
    np.testing.assert_allclose(samples["direction"][1], (0.0, 0.0, -1.0), atol=1e-7)
    np.testing.assert_array_equal(samples["irradiance"], [(3.0, 2.0, 1.0)] * 2)
    np.testing.assert_allclose(samples["distance"], (math.sqrt(5.25), 4.0), rtol=1e-6)


def test_hard_rectangles() -> None:
    """2 by 3 units of radiance at 6 units: 6 / 36, half of it 60 degrees off, nothing behind, and never above pi."""
    there = light(LIGHT_RECT, position=(0.0, 6.0, 0.0), edge_u=(2.0, 0.0, 0.0), edge_v=(0.0, 0.0, 3.0))
    np.testing.assert_allclose(there["direction"][0], (0.0, -1.0, 0.0))
    slanted = (6.0 * math.sin(math.pi / 3), 6.0 - 6.0 * math.cos(math.pi / 3), 0.0)
    samples = seen(there, [(0.0, 0.0, 0.0), slanted, (0.0, 7.0, 0.0), (1.0, 6.0, 0.0), (0.0, 5.9, 0.0)])
    expected = 3.0 * np.array([1.0 / 6.0, 1.0 / 12.0, 0.0, 0.0, math.pi])
    np.testing.assert_allclose(samples["irradiance"][:, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(samples["distance"][:2], 6.0, rtol=1e-6)
    assert not samples["pdf"].any()


def test_hard_lights_have_no_extent() -> None:
    """Radius, angle and edges count for soft light only, and random numbers too."""
    for kind in (LIGHT_POINT, LIGHT_SPOT, LIGHT_DIRECTIONAL):
        sharp, wide = (light(kind, radius=radius, inner=0.1, outer=1.0) for radius in (0.0, 0.7))
        for u in ((0.0, 0.0), (0.3, 0.8)):
            samples = [seen(which, (0.4, 3.0, 0.1), u=np.array([u])) for which in (sharp, wide)]
            assert samples[0] == samples[1]
        assert seen(sharp, (0.4, 3.0, 0.1)) == seen(sharp, (0.4, 3.0, 0.1), soft=True)


def test_environments_are_elsewhere() -> None:
    """Their samples come by another function; here they give nothing."""
    assert not seen(light(LIGHT_ENVIRONMENT), (0.0, 0.0, 0.0), soft=True)["irradiance"].any()


# --- Geometry ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("ratio", [1e-5, 1e-3, 0.05, 0.5, 0.9, 0.999])
def test_directions_meet_the_sphere(ratio: float, device: str) -> None:
    """Every direction does, where the distance says; density is one over the solid angle, irradiance its radiance."""
    rng = np.random.default_rng(2)
    distance = 3.0
    point = np.array(POSITION) + distance * AXIS
    radius = ratio * distance
    samples = seen(light(LIGHT_POINT, radius=radius), point, True, rng.random((5000, 2)), device)
    directions = samples["direction"].astype(np.float64)
    assert not np.isnan(first_hit(point, directions, np.array(POSITION), radius + 1e-6 * distance)).any()
    # From its centre, where they end is as far as its radius, on the near side.
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
def test_spheres_give_what_points_give(ratio: float, tilt: float) -> None:
    """Wholly above the horizon: candela over squared distance, times the cosine of the centre's direction."""
    point = np.array(POSITION) + 3.0 * AXIS
    normal = -math.cos(tilt) * AXIS + math.sin(tilt) * ACROSS
    samples = seen(light(LIGHT_POINT, radius=3.0 * ratio), point, True, grid(256))
    expected = np.array([3.0, 2.0, 1.0]) / 9.0 * math.cos(tilt)
    if math.asin(ratio) + tilt > math.pi / 2.0:
        pytest.skip("partly below the horizon")
    np.testing.assert_allclose(gathered(samples, normal), expected, rtol=1e-4)


def test_soft_lights_fade_by_their_centres() -> None:
    """Range and cone of a spot with a radius are those of its centre."""
    there = light(LIGHT_SPOT, radius=0.3, inner=0.2, outer=0.5, range=4.0)
    angle = 0.35
    way = math.cos(angle) * AXIS + math.sin(angle) * ACROSS
    point = np.array(POSITION) + 3.0 * way
    expected = 3.0 / 9.0 * float(cone(angle, 0.2, 0.5) * window(3.0, 4.0))
    assert gathered(seen(there, point, True, grid(128)), -way)[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("share", [0.0, 1e-8, 0.3, 0.999, 1.001])
def test_inside_spheres(share: float) -> None:
    """As bright as at the surface, towards the centre; at the centre itself, dark. No jump at the surface."""
    point = np.array(POSITION) + share * 0.5 * AXIS
    samples = seen(light(LIGHT_POINT, radius=0.5), point, True, grid(64))
    if share > 1e-6:
        assert gathered(samples, -AXIS)[0] == pytest.approx(3.0 / 0.25, rel=3e-3)
    assert np.isfinite(samples["irradiance"]).all()


@pytest.mark.parametrize("angle", [1e-4, 0.00465, 0.1, 1.0, math.pi / 2.0])
def test_suns(angle: float) -> None:
    """The mean irradiance of a surface that faces it is the lux, and all directions are within the angle."""
    samples = seen(light(LIGHT_DIRECTIONAL, radius=angle), (0.0, 0.0, 0.0), True, grid(256))
    np.testing.assert_allclose(gathered(samples, -AXIS), (3.0, 2.0, 1.0), rtol=1e-4)
    off = np.linalg.norm(samples["direction"] + AXIS, axis=1)  # chord
    assert off.max() <= 2.0 * math.sin(0.5 * angle) + 3e-7
    # Evenly: the squared chord is even.
    assert np.mean(off**2) == pytest.approx(2.0 * math.sin(0.5 * angle) ** 2, rel=1e-2)
    mean = samples["direction"].mean(axis=0, dtype=np.float64)
    np.testing.assert_allclose(mean @ np.array([AXIS, ACROSS, np.cross(AXIS, ACROSS)]).T[:, 1:], 0.0, atol=2e-5)
    np.testing.assert_allclose(samples["pdf"], 1.0 / cap(angle), rtol=1e-4)
    assert np.isinf(samples["distance"]).all()


@pytest.mark.parametrize("seed", range(6))
def test_rectangles_give_what_lambert_says(seed: int) -> None:
    """A parallelogram over a receiver that looks its way, and the solid angle that its density stands for."""
    rng = np.random.default_rng(seed)
    position = np.array([0.0, 0.0, 2.0]) + 0.3 * rng.normal(size=3)
    edge_u, edge_v = np.array([0.0, 1.2, 0.0]) + 0.2 * rng.normal(size=3), np.array([0.8, 0.0, 0.0])
    normal = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    corners = np.array(
        [position + a * edge_u + b * edge_v for a, b in ((-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5), (0.5, -0.5))]
    )
    assert (corners @ normal > 0.0).all()
    there = light(LIGHT_RECT, position=position, edge_u=edge_u, edge_v=edge_v)
    samples = seen(there, (0.0, 0.0, 0.0), True, grid(128))
    expected = abs(polygon_irradiance(corners, np.zeros(3), normal))
    np.testing.assert_allclose(gathered(samples, normal), expected * np.array([3.0, 2.0, 1.0]), rtol=2e-4)
    # Towards each point of it, and as dense as that point is seen large.
    u = grid(128) - 0.5
    points = position + u[:, :1] * edge_u + u[:, 1:] * edge_v
    np.testing.assert_allclose(samples["distance"][:, None] * samples["direction"], points, atol=1e-5)
    np.testing.assert_allclose(samples["irradiance"][:, 0] * samples["pdf"], 3.0, rtol=1e-5)
    # Nothing on its other side.
    behind = seen(there, 2.0 * position, True, grid(4))
    assert not behind["irradiance"].any()


@pytest.mark.parametrize("seed", range(4))
def test_disks_give_what_lambert_says(seed: int) -> None:
    """A disk over a receiver that looks its way, as a polygon of many corners; samples are even over its area."""
    rng = np.random.default_rng(seed)
    position, axis = np.array([0.0, 0.0, 2.0]) + 0.3 * rng.normal(size=3), np.array([0.0, 0.0, -1.0])
    axis = axis + 0.3 * rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    normal = np.array([0.0, 0.0, 1.0]) + 0.2 * rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    u = np.cross(axis, (1.0, 0.0, 0.0))
    u /= np.linalg.norm(u)
    v, turn = np.cross(axis, u), 2.0 * np.pi * np.arange(4000)[:, None] / 4000
    corners = position + 0.7 * (np.cos(turn) * u + np.sin(turn) * v)
    assert (corners @ normal > 0.0).all()
    there = light(LIGHT_DISK, position=position, direction=axis, radius=0.7)
    samples = seen(there, (0.0, 0.0, 0.0), True, grid(128))
    expected = abs(polygon_irradiance(corners, np.zeros(3), normal))
    np.testing.assert_allclose(gathered(samples, normal), expected * np.array([3.0, 2.0, 1.0]), rtol=2e-4)
    np.testing.assert_allclose(samples["irradiance"][:, 0] * samples["pdf"], 3.0, rtol=1e-5)
    offsets = samples["distance"][:, None] * samples["direction"].astype(np.float64) - position
    np.testing.assert_allclose(offsets @ axis, 0.0, atol=2e-6)
    shares = (offsets**2).sum(axis=1) / 0.49
    np.testing.assert_allclose(np.quantile(shares, (0.25, 0.5, 0.75, 1.0)), (0.25, 0.5, 0.75, 1.0), atol=0.01)
    np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=1e-5)
    assert not seen(there, position - 0.1 * axis, True, grid(4))["irradiance"].any()


@pytest.mark.parametrize("height", [0.05, 0.7, 20.0])
def test_a_disk_above_its_axis(height: float) -> None:
    """Radiance times pi r^2 / (r^2 + h^2); hard, all of it at the centre, but never above pi."""
    there = light(LIGHT_DISK, position=(0.0, height, 0.0), direction=(0.0, -1.0, 0.0), radius=0.7)
    up = np.array([0.0, 1.0, 0.0])
    radii2 = np.stack([(np.arange(20000) + 0.5) / 20000, np.full(20000, 0.3)], axis=1)
    soft = gathered(seen(there, (0.0, 0.0, 0.0), True, radii2), up)
    assert soft[0] == pytest.approx(3.0 * math.pi * 0.49 / (0.49 + height**2), rel=1e-3)
    hard = gathered(seen(there, (0.0, 0.0, 0.0)), up)
    assert hard[0] == pytest.approx(3.0 * math.pi * min(0.49 / height**2, 1.0), rel=1e-5)


FLAT = {
    LIGHT_RECT: {"edge_u": (0.9, 0.1, 0.0), "edge_v": (0.0, 0.2, 1.1)},
    LIGHT_DISK: {"radius": 0.6},
    LIGHT_POINT: {"radius": 0.6},
}


@pytest.mark.parametrize("kind", FLAT)
def test_rays_cross_lights_where_samples_lie(kind: Any) -> None:
    """At the same distance and with the same density, which integrates to one over all directions."""
    there = light(kind, **FLAT[kind])
    towards = there["direction"][0].astype(np.float64)
    point = np.array(POSITION) + 1.3 * towards + 0.4 * np.cross(towards, (1.0, 0.0, 0.0))
    samples = seen(there, point, True, np.clip(grid(40), 0.001, 0.999))
    crossings = crossed(there, point, samples["direction"])
    assert np.isfinite(crossings["t"]).all()
    np.testing.assert_allclose(crossings["t"], samples["distance"], rtol=1e-3 if kind == LIGHT_POINT else 1e-5)
    np.testing.assert_allclose(crossings["pdf"], samples["pdf"], rtol=1e-4)
    cells = grid(1200)
    height, turn = 2.0 * cells[:, 0] - 1.0, 2.0 * math.pi * cells[:, 1]
    around = np.stack(
        [np.sqrt(1.0 - height**2) * np.cos(turn), height, np.sqrt(1.0 - height**2) * np.sin(turn)], axis=1
    )
    densities = crossed(there, point, around)["pdf"].astype(np.float64)
    assert 4.0 * math.pi * densities.mean() == pytest.approx(1.0, rel=3e-3)
    assert np.isinf(crossed(there, point, -samples["direction"])["t"]).all()


def test_lambert_by_hand() -> None:
    """A disc of many corners straight above: sin^2 of its angular radius times pi."""
    turn = 2.0 * np.pi * np.arange(4000) / 4000
    corners = np.stack([0.7 * np.cos(turn), 0.7 * np.sin(turn), np.ones(4000)], axis=1)
    disc = polygon_irradiance(corners, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert abs(disc) == pytest.approx(math.pi * 0.49 / 1.49, rel=1e-5)


# --- Whatever the numbers ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_finite(kind: Any, soft: bool, device: str) -> None:
    """Points at, next to and far from lights of any size and power."""
    offsets = [0.0, 1e-30, 1e-18, 1e-9, 1e-4, 1.0, 1e9, 1e18]
    points = np.array([(sign * x, y, 0.0) for x in offsets for y in offsets for sign in (-1.0, 1.0)])
    for size in (0.0, 1e-20, 1e-5, 1.0, 1e18):
        for power in (0.0, 1e-30, 1.0, 1e30):
            for reach in (1e-30, 1.0, math.inf):
                there = light(
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
                    samples = seen(there, points, soft, np.tile(np.array([u]), (len(points), 1)), device)
                    for name in ("direction", "irradiance", "pdf"):
                        assert np.isfinite(samples[name]).all(), (name, size, power, reach, u)
                    assert not np.isnan(samples["distance"]).any()
                    assert (samples["distance"] >= 0.0).all()
                    assert (samples["irradiance"] >= 0.0).all()
                    np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0, atol=1e-5)
