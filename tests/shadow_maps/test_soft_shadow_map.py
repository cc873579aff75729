"""Penumbrae of lights with an extent by deep shadow maps: against similar triangles, exact rays and a float64 twin."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.oracles import deep_shadow_oracle as oracle
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians

HEIGHT = 4.0
"""Height of the lights above the floor, the plane z = 0."""
ABOVE = (0.0, 0.0, HEIGHT)
RADIUS = 0.4
DOWN = (0.0, 0.0, -1.0)
LIGHTS: dict[str, Any] = {
    "sphere": ls.LightSphere(ABOVE, radius=RADIUS),
    "point": ls.LightPoint(ABOVE, radius=RADIUS),
    "spot": ls.LightSpot(ABOVE, direction=DOWN, radius=RADIUS),
    "disk": ls.LightDisk(ABOVE, direction=DOWN, radius=RADIUS),
    "rect": ls.LightRect(ABOVE, edge_u=(0.0, 2.0 * RADIUS, 0.0), edge_v=(2.0 * RADIUS, 0.0, 0.0)),
    "sun": ls.LightDirectional(DOWN, angle=np.arctan(RADIUS / HEIGHT)),
}
FLOOR = np.concatenate([np.random.default_rng(0).uniform(-2.0, 2.0, (2000, 2)), np.zeros((2000, 1))], axis=1)


def half_plane(height: float, step: float = 0.02) -> ls.Gaussians:
    """Returns opaque discs that cover x < 0 at a height above the floor, around the origin."""
    # A disc is opaque to about a step from its mean.
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-0.5, -0.5 * step, step), np.arange(-0.3, 0.3, step)))
    count = len(x)
    means = np.stack([x, y, np.full(count, height)], axis=1)
    scales = np.tile([0.5 * step, 0.5 * step, 0.02 * step], (count, 1))
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return ls.Gaussians(means, turns, scales, np.full(count, 0.99), np.zeros((count, 1, 3)))


def build(casters: Any, light: Any, receivers: Any = None, **settings: Any) -> ls.DeepShadowMap:
    """Builds a map on the CPU."""
    config = replace(ls.config.DeepShadowConfig(resolution=1024, bins=128), **settings)
    return ls.DeepShadowMap.build(casters, light, receivers, config, device="cpu")


@pytest.mark.parametrize("height", [0.3, 1.5])
@pytest.mark.parametrize("kind", list(LIGHTS))
def test_penumbra_of_an_edge_is_as_wide_as_similar_triangles_say(kind: str, height: float) -> None:
    """The transmittance across a shadow's edge is the visible fraction of the light; nearer casters have sharper edges.

    A light of diameter d at distance D over an edge, which is h above the floor, has a penumbra of width d h / D.
    """
    width = 2.0 * RADIUS * height / (HEIGHT if kind == "sun" else HEIGHT - height)
    x = np.linspace(-width, width, 81)
    grid = np.stack(np.meshgrid(x, np.linspace(-0.05, 0.05, 16), [0.0], indexing="ij"), axis=-1)
    seen = (
        build(half_plane(height), LIGHTS[kind], FLOOR).transmittance(grid.reshape(-1, 3)).reshape(81, 16).mean(axis=1)
    )
    at = 2.0 * x / width
    expected = np.clip(0.5 + 0.5 * at, 0.0, 1.0) if kind == "rect" else oracle.disk_beside(at)
    middle = np.interp(0.5, seen, x)  # the discs blur the edge itself by a centimetre
    assert abs(middle) < 0.02
    np.testing.assert_allclose(np.interp(x + middle, x, seen)[10:-10], expected[10:-10], atol=0.07)


@pytest.mark.parametrize("kind", ["sphere", "rect", "sun"])
def test_soft_deep_shadows_are_close_to_the_mean_of_exact_rays_to_the_light(kind: str) -> None:
    """Mean errors are below 0.02 behind Gaussians of all shapes and depths; those of a point light are above 0.06.

    Receivers around the shadow of a small ball see it only from the rim of the light.
    """
    casters = joined(
        random_gaussians(1, 40, center=(0.0, 0.0, 1.5), extent=(0.5, 0.5, 0.6), scale_range=(0.02, 0.2)),
        one_gaussian((1.2, 0.0, 1.8), 0.04, 0.99),
    )
    light = LIGHTS[kind]
    if kind == "sun":
        points = 1e4 * (np.array([0.0, 0.0, 1.0]) + oracle.disk_points(RADIUS / HEIGHT, np.array(DOWN), 64))
        hard: Any = ls.LightDirectional(DOWN)
    else:
        u, v = (np.arange(64) + 0.5) / 64.0, np.arange(64) * 0.618034 % 1.0
        square = RADIUS * np.stack([2.0 * u - 1.0, 2.0 * v - 1.0, 0.0 * u], axis=1)
        points = np.array(ABOVE) + (square if kind == "rect" else oracle.disk_points(RADIUS, np.array(DOWN), 64))
        hard = ABOVE
    floor = FLOOR[:150]
    expected = oracle.soft_transmittance(oracle.absorbers(casters), points, floor)
    partly = (expected > 0.05) & (expected < 0.95)
    error, error_of_point = (
        np.abs(build(casters, one, FLOOR).transmittance(floor) - expected)[partly].mean() for one in (light, hard)
    )
    assert error < 0.02
    assert error_of_point > 3.0 * error


def test_rays_through_a_deep_shadow_map_match_the_float64_twin() -> None:
    """The mean of many rays is that of the twin, which steps through the same texels and bins."""
    casters = random_gaussians(1, 20, center=(0.0, 0.0, 1.5), extent=(0.5, 0.5, 0.6), scale_range=(0.1, 0.3))
    points = FLOOR[:200]
    shadow = build(casters, LIGHTS["rect"], resolution=88, bins=16, max_distance=5.0, samples=1024)
    rng = np.random.default_rng(2)
    cells = (np.stack(np.meshgrid(*2 * [np.arange(16)]), axis=-1).reshape(-1, 2) + rng.uniform(size=(256, 2))) / 16.0
    lights = np.concatenate([2.0 * RADIUS * (cells[:, ::-1] - 0.5), np.zeros((256, 1))], axis=1)
    shifts = rng.permutation(cells)
    table = oracle.tabulate(oracle.absorbers(casters), np.array(ABOVE), ls.config.AtlasLayout.OCTAHEDRAL, 64, 16, 5.0)
    depths = shadow._extent.near, shadow._extent.far
    expected = oracle.look_up_rays(table, points, lights, shifts, depths, 4.0)
    assert expected.min() < 0.3
    seen = shadow.transmittance(points)
    assert np.abs(seen - expected).mean() < 3e-3
    np.testing.assert_allclose(seen, expected, atol=0.02)


@pytest.mark.parametrize(
    ("light", "points"),
    [
        (ls.LightSphere(ABOVE, radius=0.8), np.array(ABOVE) + oracle.disk_points(0.8, np.array(DOWN), 128)),
        (
            ls.LightDirectional(DOWN, angle=np.radians(20.0)),
            1e4 * (np.array([0.0, 0.0, 1.0]) + oracle.disk_points(np.tan(np.radians(20.0)), np.array(DOWN), 128)),
        ),
    ],
    ids=["sphere", "sun"],
)
def test_ball_shadows_receivers_that_only_the_rim_of_the_light_misses(light: Any, points: np.ndarray) -> None:
    """A ball shadows points outside of its shadow from the light's centre; a sun's map covers what is beside them."""
    ball, patch = one_gaussian((0.6, 0.0, 2.0), 0.04, 0.99), np.array([0.2, 0.2, 1.0]) * FLOOR[:100]
    seen = build(ball, light, patch, samples=128).transmittance(patch)
    expected = oracle.soft_transmittance(oracle.absorbers(ball), points, patch)
    assert expected.mean() < 0.999
    assert 1.0 - seen.mean() == pytest.approx(1.0 - expected.mean(), rel=0.15)


@pytest.mark.parametrize("receivers", [None, FLOOR], ids=["casters only", "receivers"])
@pytest.mark.parametrize("kind", ["sphere", "rect", "sun"])
def test_saved_soft_shadow_map_and_its_rebuild_give_the_same_bits(kind: str, receivers: Any, tmp_path: Path) -> None:
    """Penumbrae do not flicker: a rebuild with the casters of before gives the transmittances of before."""
    shadow = build(half_plane(1.0, 0.05), LIGHTS[kind], receivers, resolution=256, bins=32)
    seen = shadow.transmittance(FLOOR)
    assert ((seen > 0.1) & (seen < 0.9)).any()
    shadow.save(tmp_path / "map.npz")
    again = ls.DeepShadowMap.load(tmp_path / "map.npz", device="cpu")
    np.testing.assert_array_equal(again.transmittance(FLOOR), seen)
    for one in (shadow, again):
        one.rebuild(half_plane(2.0, 0.05))
        assert (one.transmittance(FLOOR) != seen).any()
        one.rebuild(half_plane(1.0, 0.05))
        np.testing.assert_array_equal(one.transmittance(FLOOR), seen)


def test_map_file_without_an_extent_is_that_of_a_point(tmp_path: Path) -> None:
    """Files of version 1 hold no extent; a damaged extent is refused."""
    shadow = build(half_plane(1.0, 0.05), ABOVE, FLOOR)
    shadow.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as file:
        arrays: dict[str, Any] = dict(file)
    header = json.loads(arrays["header"].tobytes())
    extent = header.pop("extent")
    for name, changed in {
        "old": header | {"version": 1},
        "shapeless": header | {"extent": extent | {"shape": 9}},
        "endless": header | {"extent": extent | {"radius": float("nan")}},
    }.items():
        arrays["header"] = np.frombuffer(json.dumps(changed).encode(), np.uint8)
        np.savez(tmp_path / f"{name}.npz", **arrays)
    old = ls.DeepShadowMap.load(tmp_path / "old.npz", device="cpu")
    np.testing.assert_array_equal(old.transmittance(FLOOR), shadow.transmittance(FLOOR))
    for name in ("shapeless", "endless"):
        with pytest.raises(ls.FormatError, match="damaged"):
            ls.DeepShadowMap.load(tmp_path / f"{name}.npz", device="cpu")


def test_receivers_beside_a_penumbra_are_lit_to_the_bit_and_those_in_the_umbra_are_dark() -> None:
    """Captured colours stay the same to the bit where no part of the light is blocked."""
    casters = half_plane(0.3)
    seen = build(casters, LIGHTS["sphere"], FLOOR).transmittance(FLOOR)
    inside = (np.abs(FLOOR[:, 1]) < 0.2) & (FLOOR[:, 0] > -0.4)
    assert (seen[FLOOR[:, 0] > 0.3] == 1.0).all()
    assert seen[inside & (FLOOR[:, 0] < -0.1)].max() < 0.02
