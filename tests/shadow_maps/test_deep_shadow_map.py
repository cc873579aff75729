"""Deep shadow maps against their float64 twin: closed form, table, and changes that must not change the map."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.shadow_maps import culling, deep_shadow_map
from support.oracles import deep_shadow_oracle as oracle
from support.oracles.raster_oracle import rotation_from_quaternion
from support.scenes.raster_scenes import joined, one_gaussian, random_gaussians, similarity

LIGHT = np.array([0.3, -0.4, 0.2])
INSIDE = one_gaussian((0.35, -0.4, 0.3), (0.5, 0.2, 0.3), 0.6, rotation=(0.9, 0.3, -0.2, 0.1))
"""Gaussian around the light."""
AROUND = joined(random_gaussians(1, 60, center=(0.0, 0.0, 0.0), extent=(2.5, 2.5, 2.5), scale_range=(0.1, 0.5)), INSIDE)
"""Casters in all directions around the light."""
T_MAX = 5.0
WHOLE = ls.config.DeepShadowConfig(resolution=128, bins=64, max_distance=T_MAX, region=False)


def build(
    casters: Any = AROUND, light: Any = LIGHT, config: ls.config.DeepShadowConfig = WHOLE, receivers: Any = None
) -> Any:
    """Builds a map on the CPU."""
    return ls.DeepShadowMap.build(casters, light, receivers, config, device="cpu")


def scattered(count: int, seed: int = 0, radius: float = 3.0) -> np.ndarray:
    """Returns points in all directions from the light, none very near."""
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    return (LIGHT + away * rng.uniform(0.5, radius, (count, 1))).astype(np.float32)


def exact(points: np.ndarray, casters: Any = AROUND, light: np.ndarray = LIGHT, **options: Any) -> np.ndarray:
    """Returns the transmittance to points by the closed form."""
    return oracle.transmittance(oracle.absorbers(casters, **options), light, points)


def texel_directions(layout: ls.config.AtlasLayout, resolution: int) -> np.ndarray:
    """Returns the directions of all N texels, shape (N, 3)."""
    if layout is ls.config.AtlasLayout.OCTAHEDRAL:
        return oracle.decode_octahedral(oracle.texel_centers(resolution)).reshape(-1, 3)
    size = round(resolution / np.sqrt(6.0) / 8) * 8
    positions = oracle.texel_centers(size)
    return np.concatenate(
        [oracle.decode_cube(np.full((size, size), face), positions).reshape(-1, 3) for face in range(6)]
    )


# --- The table ---


@pytest.mark.parametrize("layout", list(ls.config.AtlasLayout))
@pytest.mark.parametrize("absorption", list(ls.config.Absorption))
def test_bins_of_a_deep_shadow_map_match_the_closed_form(
    layout: ls.config.AtlasLayout, absorption: ls.config.Absorption
) -> None:
    """Transmittance is within 1e-3 at the centres of bins along texels' rays, for any absorption and layout."""
    config = replace(WHOLE, layout=layout, absorption=absorption, strength=0.7)
    rng = np.random.default_rng(0)
    directions = texel_directions(layout, config.resolution)
    directions = directions[rng.integers(len(directions), size=400)]
    distances = oracle.bin_centers(config.bins, T_MAX)[rng.integers(config.bins, size=400)]
    points = LIGHT + directions * distances[:, None]
    expected = exact(points, absorption=absorption, strength=0.7)
    assert expected.min() < 0.3
    assert expected.max() > 0.9
    np.testing.assert_allclose(build(config=config).transmittance(points), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("scale", "distance"),
    [((0.4, 0.4, 1e-3), 3.0), ((1e-3, 0.4, 0.4), 3.0), ((0.02, 0.02, 0.8), 3.0), ((2.0, 1.0, 0.01), 80.0)],
    ids=["disc", "disc on edge", "needle", "far"],
)
def test_deep_shadow_of_thin_and_far_casters_matches_the_closed_form(
    scale: tuple[float, float, float], distance: float
) -> None:
    """Transmittance is within 1e-3 before, within and behind the caster, where float32 could cancel."""
    caster = one_gaussian((0.0, 0.0, distance), scale, 0.9, rotation=(0.999, 0.03, -0.02, 0.01))
    reach = 2.0 * distance
    config = replace(WHOLE, resolution=512, bins=32, max_distance=reach)
    directions = texel_directions(ls.config.AtlasLayout.OCTAHEDRAL, 512)
    directions = directions[directions[:, 2] > 0.999]
    points = (directions[:, None] * oracle.bin_centers(32, reach)[:, None]).reshape(-1, 3)
    seen = build(caster, np.zeros(3), config).transmittance(points)
    np.testing.assert_allclose(seen, exact(points, caster, np.zeros(3)), atol=1e-3)
    assert seen.min() < 0.7


def test_deep_shadow_map_lookups_match_the_float64_reference() -> None:
    """Trilinear lookups cover the fold and corners of the square map, and points outside the first and last bin."""
    config = replace(WHOLE, resolution=16, bins=8, max_distance=3.0)
    points = scattered(3000, radius=4.0)
    points[:50] = LIGHT + (points[:50] - LIGHT) * 0.05
    table = oracle.tabulate(oracle.absorbers(AROUND), LIGHT, ls.config.AtlasLayout.OCTAHEDRAL, 16, 8, 3.0)
    np.testing.assert_allclose(build(config=config).transmittance(points), oracle.look_up(table, points), atol=2e-4)


@pytest.mark.parametrize("layout", list(ls.config.AtlasLayout))
def test_error_of_a_deep_shadow_map_decreases_with_resolution(layout: ls.config.AtlasLayout) -> None:
    """Four times the texels and bins reduce errors to less than a sixth, even with the light inside a Gaussian."""
    points = scattered(1000)
    expected = exact(points)
    errors = []
    for resolution in (32, 64, 128):
        config = replace(WHOLE, layout=layout, resolution=resolution, bins=resolution)
        errors.append(np.abs(build(config=config).transmittance(points) - expected).mean())
    # Cube faces have multiples of 8 texels, so that not every step doubles their size.
    assert errors[2] < errors[0] / 6.0
    assert errors[2] < 1e-3


@pytest.mark.parametrize("layout", list(ls.config.AtlasLayout))
def test_errors_of_a_deep_shadow_map_are_no_larger_at_atlas_seams_than_elsewhere(layout: ls.config.AtlasLayout) -> None:
    """Errors on circles over the rim of the square map, or over edges of the cube, are as small as elsewhere."""
    rotation = np.linspace(0.0, 2.0 * np.pi, 2000, endpoint=False)
    circles = [
        np.stack(
            [np.cos(rotation), np.sin(rotation), np.full_like(rotation, -0.6)], axis=1
        ),  # crosses all four folded edges
        np.stack([np.cos(rotation), 0.3 * np.cos(rotation), np.sin(rotation)], axis=1),  # a great circle near the pole
        np.stack(
            [np.cos(rotation), np.sin(rotation), np.zeros_like(rotation)], axis=1
        ),  # the diamond within the square
    ]
    shadow = build(config=replace(WHOLE, layout=layout, resolution=256))
    for circle in circles:
        points = LIGHT + 2.5 * circle / np.linalg.norm(circle, axis=1, keepdims=True)
        error = shadow.transmittance(points) - exact(points)
        assert np.abs(error).max() < 1e-2
        # A seam would be a jump between samples, of which there are four or more per texel.
        jump = np.abs(np.diff(error, append=error[:1]))
        assert jump.max() < 6e-3


# --- Invariances ---


@pytest.mark.parametrize("resolution", [8, 16, 40, 128])
@pytest.mark.parametrize("layout", list(ls.config.AtlasLayout))
@pytest.mark.parametrize("light", [LIGHT, ls.LightDirectional((0.2, -0.1, 1.0))], ids=["point", "directional"])
def test_tile_culling_does_not_change_a_deep_shadow_map(
    resolution: int, layout: ls.config.AtlasLayout, light: Any
) -> None:
    """Culled by tiles of any size or not at all, transmittances are equal up to float32 rounding."""
    casters = joined(AROUND, random_gaussians(2, 200, center=(0.0, 0.0, 2.0), scale_range=(0.003, 0.3)))
    points = scattered(2000)
    config = replace(WHOLE, layout=layout, resolution=resolution, bins=16, max_distance=None)
    culled, every = (build(casters, light, replace(config, culling=culling), points) for culling in (True, False))
    assert culled.stats.pairs < (0.5 if resolution == 128 else 1.01) * every.stats.pairs
    np.testing.assert_allclose(culled.transmittance(points), every.transmittance(points), atol=3e-5)


def test_deep_shadow_map_is_equal_if_several_threads_sum_parts_of_a_caster_list(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Several CUDA threads sum parts of a cell's casters in the order of the list."""
    config = replace(WHOLE, bins=16, max_distance=None)
    whole = build(config=config)
    launcher = deep_shadow_map.Launcher
    monkeypatch.setattr(deep_shadow_map, "Launcher", lambda device: launcher(device, parallel=True))
    for parts in (1, 300, 10_000):  # fewer cells, of which more than one has casters
        monkeypatch.setattr(culling, "PARALLEL_PARTS", parts)
        parted = build(config=config)
        assert parted.stats.pairs == whole.stats.pairs
        np.testing.assert_array_equal(parted.transmittance(scattered(500)), whole.transmittance(scattered(500)))
    far_receivers = random_gaussians(3, 20, center=(500.0, 500.0, 500.0))
    empty = build(light=(0.0, 0.0, 10.0), config=ls.config.DeepShadowConfig(region_radius=1.0), receivers=far_receivers)
    np.testing.assert_array_equal(empty.transmittance_of(far_receivers), 1.0)


@pytest.mark.parametrize(
    "light",
    [
        pytest.param((0.0, 0.0, -3.0), id="point"),
        pytest.param(ls.LightDirectional((0.0, 0.0, 1.0)), id="sun", marks=pytest.mark.deep),
    ],
)
def test_culling_in_a_deep_shadow_map_keeps_shadows_that_reach_only_outer_samples(light: Any) -> None:
    """Only the outermost samples of a wide receiver reach the shadow of a small caster."""
    caster = one_gaussian((0.0, 0.0, 0.0), (0.03, 0.03, 0.03), 0.95)
    rng = np.random.default_rng(0)
    rotation, away = rng.uniform(0.0, 2.0 * np.pi, 40_000), rng.uniform(0.8, 1.4, 40_000)
    receivers = replace(
        random_gaussians(4, 40_000),
        means=np.stack([away * np.cos(rotation), away * np.sin(rotation), np.ones_like(away)], axis=1).astype(
            np.float32
        ),
        scales=np.full((40_000, 3), 0.3, np.float32),
    )
    config = ls.config.DeepShadowConfig(resolution=1024, bins=8, samples=64)
    culled, every = (
        build(caster, light, replace(config, culling=culling), receivers).transmittance_of(receivers)
        for culling in (True, False)
    )
    assert (every < 0.99).sum() > 5
    np.testing.assert_allclose(culled, every, atol=3e-5)


@pytest.mark.parametrize("sampling", list(ls.config.ReceiverSampling))
def test_deep_shadow_map_computed_in_the_region_of_receivers_equals_the_whole_map(
    sampling: ls.config.ReceiverSampling,
) -> None:
    """Results agree to rounding, because bins are summed from the begin of their column."""
    receivers = random_gaussians(4, 500, center=(0.0, 0.5, 1.0), extent=(2.0, 0.2, 2.0), scale_range=(0.01, 0.2))
    part, whole = (
        build(config=replace(WHOLE, region=region, sampling=sampling), receivers=receivers) for region in (True, False)
    )
    assert part.stats.voxels < 0.5 * whole.stats.voxels
    np.testing.assert_allclose(part.transmittance_of(receivers), whole.transmittance_of(receivers), atol=5e-7)


def test_rebuilt_deep_shadow_map_equals_a_new_map() -> None:
    """A rebuild for other casters, then for the first ones, gives the bits of new maps in the same memory."""
    receivers = random_gaussians(4, 500, center=(0.0, 0.5, 1.0), extent=(2.0, 0.2, 2.0))
    moved = ls.SplatInstance(AROUND, similarity((0.0, 1.0, 0.0), 0.2, 1.0, (0.1, 0.0, 0.1)))
    shadow = build(receivers=receivers)
    first = shadow.transmittance_of(receivers)
    shadow.rebuild(moved)
    np.testing.assert_array_equal(
        shadow.transmittance_of(receivers), build(moved, receivers=receivers).transmittance_of(receivers)
    )
    assert not np.array_equal(shadow.transmittance_of(receivers), first)
    held = shadow.bytes
    for _ in range(2):  # Static actors do not flicker.
        shadow.rebuild(AROUND)
        np.testing.assert_array_equal(shadow.transmittance_of(receivers), first)
    assert shadow.bytes == held


def test_deep_shadow_map_with_average_absorption_does_not_depend_on_the_scenes_scale() -> None:
    """Casters, light and receivers ten times as large have the same shadows with the absorption `avg`."""
    points = scattered(500)
    ten = np.diag([10.0, 10.0, 10.0, 1.0])
    config = replace(WHOLE, max_distance=10.0 * T_MAX)
    large = build(ls.SplatInstance(AROUND, ten), 10.0 * LIGHT, config).transmittance(10.0 * points)
    np.testing.assert_allclose(large, build().transmittance(points), atol=1e-4)


def test_deep_shadow_map_does_not_depend_on_the_order_of_casters() -> None:
    """The optical depth is a sum over casters."""
    points = scattered(500)
    turned = AROUND.subset(np.arange(len(AROUND))[::-1])
    np.testing.assert_allclose(build(turned).transmittance(points), build().transmittance(points), atol=1e-5)


def test_casters_behind_the_light_or_the_receivers_leave_deep_shadows_equal_to_the_bit() -> None:
    """The rays from the light to the receivers end before they reach such casters."""
    points = LIGHT + np.random.default_rng(0).uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 2.0], (500, 3))
    expected = build(receivers=points).transmittance(points)
    for position in ((0.3, -0.4, -1.2), (0.3, -0.4, 4.5)):
        more = joined(AROUND, one_gaussian(position, (0.1, 0.2, 0.15), 0.9))
        np.testing.assert_array_equal(build(more, receivers=points).transmittance(points), expected)


# --- Directional light ---


def test_deep_shadow_map_of_a_sun_is_the_limit_of_far_point_lights() -> None:
    """The map converges to the closed form of lights so far away that no caster is behind them."""
    sun = ls.LightDirectional((0.3, -0.5, 1.0))
    points = np.random.default_rng(3).uniform(-2.5, 2.5, (1000, 3)).astype(np.float32)
    direction = np.array(sun.direction) / np.linalg.norm(sun.direction)
    expected = exact(points, light=points - 100.0 * direction)
    errors = []
    for size in (32, 64, 128):
        seen = build(light=sun, config=ls.config.DeepShadowConfig(resolution=size, bins=size), receivers=points)
        errors.append(np.abs(seen.transmittance(points) - expected).mean())
    assert errors[1] < 0.4 * errors[0]
    assert errors[2] < 0.4 * errors[1]
    assert errors[2] < 2e-3


# --- Receivers' footprints ---


def receivers_of(count: int = 40) -> ls.Gaussians:
    """Returns rotated, anisotropic receivers."""
    return random_gaussians(7, count, center=(0.5, 0.5, 1.0), extent=(1.5, 1.5, 1.5), scale_range=(0.05, 0.6))


def test_center_sampling_reads_a_deep_shadow_map_at_the_mean_of_each_receiver() -> None:
    """The single sample is at the mean of the receiver."""
    shadow = build(config=replace(WHOLE, sampling=ls.config.ReceiverSampling.CENTER))
    receivers = receivers_of()
    np.testing.assert_array_equal(shadow.transmittance_of(receivers), shadow.transmittance(receivers.means))


def test_stencil_sampling_averages_a_deep_shadow_map_over_seven_points_of_each_receiver() -> None:
    """The result is the weighted mean of the map at the twin's seven points."""
    shadow = build(config=replace(WHOLE, sampling=ls.config.ReceiverSampling.STENCIL))
    receivers = receivers_of()
    points = oracle.footprint_points(receivers, oracle.STENCIL)
    expected = shadow.transmittance(points.reshape(-1, 3)).reshape(-1, 7) @ oracle.stencil_weights()
    np.testing.assert_allclose(shadow.transmittance_of(receivers), expected, atol=1e-4)


def test_monte_carlo_sampling_of_a_deep_shadow_map_converges_to_the_mean_over_the_receiver() -> None:
    """1024 points are within four standard errors; different seeds give different points."""
    receivers = receivers_of()
    shadow = build(config=replace(WHOLE, samples=1024))
    rng = np.random.default_rng(11)
    points = oracle.footprint_points(receivers, rng.normal(size=(len(receivers), 4096, 3)))
    transmittances = shadow.transmittance(points.reshape(-1, 3)).reshape(len(receivers), -1)
    found = shadow.transmittance_of(receivers)
    error = transmittances.std(axis=1) * np.sqrt(1.0 / 1024 + 1.0 / 4096) + 1e-4
    assert (np.abs(found - transmittances.mean(axis=1)) < 4.0 * error).all()
    few, others = (build(config=replace(WHOLE, seed=seed)).transmittance_of(receivers) for seed in (0, 1))
    assert not np.array_equal(few, others)
    np.testing.assert_allclose(few.mean(), others.mean(), atol=0.02)


def test_sample_points_of_a_deep_shadow_map_rotate_with_the_receiver() -> None:
    """The extent of a flat receiver along the edge of a shadow does not matter; across the edge it does."""
    wall = one_gaussian((-2.0, 0.0, 2.0), (0.5, 3.0, 0.01), 0.99)
    shadow = build(wall, np.zeros(3), replace(WHOLE, resolution=256, samples=256))
    spot = (-1.0, 0.0, 3.0)
    along, across = (one_gaussian(spot, scale, 0.9) for scale in ((1e-3, 0.5, 1e-3), (0.5, 1e-3, 1e-3)))
    quarter = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    turned = one_gaussian(spot, (1e-3, 0.5, 1e-3), 0.9, rotation=quarter)
    center = shadow.transmittance(np.array([spot]))
    assert abs(shadow.transmittance_of(along) - center) < 0.03
    assert abs(shadow.transmittance_of(across) - center) > 0.06
    np.testing.assert_allclose(shadow.transmittance_of(turned), shadow.transmittance_of(across), atol=0.03)
    assert rotation_from_quaternion(np.array([quarter]))[0, :, 1] == pytest.approx([-1.0, 0.0, 0.0])
