"""The float64 oracle of the ray tracer agrees with hand calculations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lumisplat.config import HitDistance, NormalMethod, ResponseConfig, TraceConfig, TraceStrategy
from lumisplat.math.color import encode_srgb
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from support.oracles import raster_oracle as oracles, trace_oracle
from support.oracles.mirror_oracle import Ray
from support.oracles.particle_oracle import Hits, hits, picked, reach_of, response, response_threshold, world_of
from support.oracles.trace_oracle import Traced, blend, outcomes, trace_one
from support.scenes.raster_scenes import (
    flat_sh,
    front_camera,
    joined,
    one_gaussian,
    opposed_sheets,
    quad,
    random_gaussians,
    similarity,
)
from support.scenes.trace_scenes import AXIS, GLASS, random_ray, trace_config


def traced(scene: Scene, ray: Ray = AXIS, **settings: Any) -> Traced:
    """Traces a ray; ``settings`` are those of ``trace_config``."""
    return trace_one(scene, ray, trace_config(**settings))


def found_on(scene: Scene, ray: Ray = AXIS, **settings: Any) -> Hits:
    """Returns the hits of a ray that are blended."""
    every = hits(world_of(scene, trace_config(**settings)), ray)
    return picked(every, every.counts)


def random_world() -> Scene:
    """Returns two instances of one set, and an instance of another set."""
    asset = random_gaussians(1, 60, degree=3, center=(0.0, 0.0, 0.0), extent=(1.0, 1.0, 1.0))
    placed = SplatInstance(asset, similarity((1.0, 2.0, 0.5), 1.1, 0.7, (-0.4, 0.1, 4.0)))
    return Scene([placed, replace(placed, world_from_object=similarity(offset=(0.3, 0.0, 4.0))), random_gaussians(2)])


# --- Hits ---


def golden_section(f: Callable[[float], float], low: float, high: float) -> float:
    """Returns the minimum of a unimodal function of one number."""
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    for _ in range(100):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        low, high = (low, b) if f(a) < f(b) else (a, high)
    return 0.5 * (low + high)


@pytest.mark.parametrize("seed", range(5))
def test_response_of_a_gaussian_along_a_ray_is_largest_at_its_peak_hit_distance(seed: int) -> None:
    """The peak maximises the response along the ray, and alpha there is opacity times exp(-d^2 / 2)."""
    rng = np.random.default_rng(seed)
    scene, ray = random_world(), random_ray(rng)
    found = found_on(scene, ray)
    means, axes, scales = (
        np.concatenate(parts) for parts in zip(*map(oracles.world_gaussians, scene.splats), strict=True)
    )
    opacities = np.concatenate([instance.gaussians.opacities for instance in scene.splats])
    precision = np.linalg.inv((axes * scales[:, None, :] ** 2) @ axes.transpose(0, 2, 1))
    assert len(found) > 3

    for t, d2, alpha, index in zip(found.t, found.d2, found.alpha, found.index, strict=True):

        def squared(s: float, i: int = index) -> float:
            offset = ray.at(s) - means[i]
            return float(offset @ precision[i] @ offset)

        best = golden_section(squared, -10.0, 20.0)
        assert t == pytest.approx(best, abs=1e-6)
        assert d2 == pytest.approx(squared(best), abs=1e-9)
        assert alpha == pytest.approx(min(0.99, opacities[index] * np.exp(-0.5 * squared(best))), rel=1e-9)


def test_ray_tracing_oracle_sorts_all_hits_by_distance_and_then_by_index() -> None:
    """Hits are exactly the Gaussians with a peak ahead and alpha >= 1/255, sorted by distance, then index."""
    scene, rng = random_world(), np.random.default_rng(7)
    world = world_of(scene, None)
    total = 0
    for _ in range(20):
        ray = replace(random_ray(rng), t_min=2.0)
        found = found_on(scene, ray)
        canonical_o = np.einsum("nij,nj->ni", world.whiten, ray.origin - world.mean)
        canonical_d = world.whiten @ ray.direction
        t = -(canonical_o * canonical_d).sum(axis=1) / (canonical_d**2).sum(axis=1)
        d2 = (np.cross(canonical_o, canonical_d) ** 2).sum(axis=1) / (canonical_d**2).sum(axis=1)
        counts = np.flatnonzero((world.opacity * np.exp(-0.5 * d2) >= 1.0 / 255.0) & (t > 2.0))
        np.testing.assert_array_equal(np.sort(found.index), counts)
        assert sorted(zip(found.t, found.index, strict=True)) == list(zip(found.t, found.index, strict=True))
        total += len(found)
    assert total > 100


@pytest.mark.parametrize("scales", [(1e-6, 1.0, 1.0), (1e-6, 1e-6, 1.0), (1e6, 1e6, 1e6), (1e6, 1e-6, 1.0)])
def test_hits_of_gaussians_with_extreme_scales_keep_their_precision(scales: tuple[float, float, float]) -> None:
    """Rays are aimed at a canonical distance of 1.5 from very flat, thin and large Gaussians."""
    rng = np.random.default_rng(3)
    gaussians = one_gaussian((0.3, -0.2, 4.0), scales, 0.8, rotation=(0.8, 0.2, -0.5, 0.3))
    world = world_of(Scene([gaussians]), trace_config())
    axes = oracles.world_gaussians(SplatInstance(gaussians))[1][0]
    for _ in range(20):
        direction = oracles.normalized(rng.normal(size=3))
        canonical = world.whiten[0] @ direction
        offset = oracles.normalized(np.cross(canonical, rng.normal(size=3))) * 1.5
        through = world.mean[0] + axes @ (offset * np.array(scales, np.float32).astype(float))
        ray = Ray(through - 3.0 * direction, direction)
        found = hits(world, ray)
        assert found.d2 == pytest.approx([2.25], rel=1e-5)
        assert found.alpha == pytest.approx([world.opacity[0] * np.exp(-1.125)], rel=1e-5)
        assert found.t[0] == pytest.approx(3.0, abs=1e-5 * max(1.0, max(scales) * 1e-4))


def test_kernels_of_all_degrees_have_equal_responses_at_three_standard_deviations() -> None:
    """All kernel degrees respond 1 at the centre and exp(-4.5) at three deviations; degree 2 is the Gaussian."""
    for degree in range(6):
        assert response(np.array(0.0), degree) == 1.0
        assert response(np.array(3.0), degree) == pytest.approx(np.exp(-4.5), rel=1e-8)
    d = np.linspace(0.0, 4.0, 50)
    np.testing.assert_allclose(response(d, 2), np.exp(-0.5 * d**2), rtol=1e-14)
    np.testing.assert_allclose(response(d, 1), np.exp(-1.5 * d), rtol=1e-14)
    np.testing.assert_allclose(response(d, 5), np.exp(-(d**5) / 54.0), rtol=1e-13)
    assert (response(d, 0)[d > 3.04] == 0.0).all()


@pytest.mark.parametrize("degree", range(6))
@pytest.mark.parametrize(
    ("opacity", "settings", "least"),
    [
        (0.8, {}, 1.0 / 255.0 / 0.8),
        (0.02, {}, 1.0 / 255.0 / 0.02),
        (0.8, {"min_response": 0.1}, 0.1 / 0.8),
        (0.8, {"min_response": 0.1, "adaptive_clamping": False}, 0.1),
        (0.02, {"min_response": 0.1, "adaptive_clamping": False}, 1.0 / 255.0 / 0.02),
    ],
)
def test_rays_just_inside_the_reach_of_a_gaussian_hit_it_and_rays_just_outside_miss_it(
    degree: int, opacity: float, settings: dict, least: float
) -> None:
    """A Gaussian is hit just inside its reach, where alpha or response are at their minimum, and missed outside."""
    threshold = response_threshold(np.array([opacity]), ResponseConfig(**settings))
    reach = reach_of(threshold, np.array([degree]))[0]
    assert response(reach, degree) == pytest.approx(least, rel=1e-12)
    gaussians = replace(one_gaussian(scale=0.5, opacity=opacity), kernel_degree=degree)
    for distance, expected in ((reach * (1.0 - 1e-6), 1), (reach * (1.0 + 1e-6), 0)):
        ray = Ray(np.array([0.5 * distance, 0.0, 0.0]), AXIS.direction)
        assert len(found_on(Scene([gaussians]), ray, **settings)) == expected


def test_kernel_degree_setting_overrides_the_degree_of_each_capture() -> None:
    """Without the setting, each capture has its own kernel degree."""
    scene = Scene([replace(one_gaussian(opacity=0.5), kernel_degree=1), one_gaussian(opacity=0.5)])
    ray = Ray(np.array([0.2, 0.0, 0.0]), AXIS.direction)
    assert found_on(scene, ray).alpha == pytest.approx([0.5 * np.exp(-1.5), 0.5 * np.exp(-0.5)], rel=1e-6)
    assert found_on(scene, ray, kernel_degree=4).alpha == pytest.approx([0.5 * np.exp(-1.0 / 18.0)] * 2, rel=1e-6)


def test_gaussians_with_opacity_below_the_minimum_are_never_hit() -> None:
    """An opacity below 1/255 or below the adaptive minimum is never a hit; alpha is at most 0.99."""
    assert len(found_on(Scene([one_gaussian(opacity=1.0 / 256.0)]))) == 0
    assert len(found_on(Scene([one_gaussian(opacity=0.0)]))) == 0
    assert len(found_on(Scene([one_gaussian(opacity=0.05)]), min_response=0.06)) == 0
    assert len(found_on(Scene([one_gaussian(opacity=0.05)]), min_response=0.06, adaptive_clamping=False)) == 1
    assert found_on(Scene([one_gaussian(opacity=1.0)])).alpha == [0.99]


@pytest.mark.parametrize("degree", [0, 2, 5])
def test_hull_hit_distance_is_the_nearer_of_two_points_on_the_ray_at_the_gaussians_reach(degree: int) -> None:
    """In hull mode, the hit is the nearer of two points on the ray whose canonical distance is the reach."""
    scene = Scene([replace(random_gaussians(4, 80), kernel_degree=degree)])
    world = world_of(scene, None)
    found = found_on(scene, hit_distance=HitDistance.HULL)
    peaks = found_on(scene)
    assert len(found) > 3
    assert set(found.index) == set(peaks.index)
    for t, i in zip(found.t, found.index, strict=True):
        canonical = np.linalg.norm(world.whiten[i] @ (AXIS.at(t) - world.mean[i]))
        assert canonical == pytest.approx(world.reach[i], rel=1e-9)
        assert t < peaks.t[peaks.index == i][0]


def test_gaussian_that_surrounds_the_eye_has_a_hull_depth_of_zero() -> None:
    """The hull begins behind the eye; whether the Gaussian is hit depends on its peak alone."""
    ahead = Scene([one_gaussian((0.0, 0.0, 0.1), 0.5, 0.9)])
    assert traced(ahead, hit_distance=HitDistance.HULL).depth == 0.0
    assert found_on(ahead, hit_distance=HitDistance.HULL).t[0] < 0.0
    assert len(found_on(ahead, replace(AXIS, t_min=0.2), hit_distance=HitDistance.HULL)) == 0


def test_hit_normal_is_the_gradient_of_squared_canonical_distance_facing_the_ray() -> None:
    """Normals are gradients of the squared canonical distance, at the eye or at the entry point, against the ray."""
    scene, rng = random_world(), np.random.default_rng(5)
    world = world_of(scene, None)
    for _ in range(5):
        ray = random_ray(rng)
        entry = found_on(scene, ray, hit_distance=HitDistance.HULL)
        for method in NormalMethod:
            found = found_on(scene, ray, normal_method=method)
            assert len(found) > 3
            for normal, i in zip(found.normal, found.index, strict=True):
                at = ray.origin if method is NormalMethod.PLANE else ray.at(entry.t[entry.index == i][0])
                step = 1e-6 * np.eye(3)
                after, before = (
                    np.array([np.sum((world.whiten[i] @ (at + sign * e - world.mean[i])) ** 2) for e in step])
                    for sign in (1.0, -1.0)
                )
                gradient = oracles.normalized(after - before)
                np.testing.assert_allclose(normal, gradient, atol=1e-5)
                assert normal @ ray.direction < 0.0


def test_direction_in_which_sh_are_evaluated_starts_at_the_eye_mirrored_behind_mirrors() -> None:
    """SH directions equal the rasteriser's, in object space, from the start of the unfolded path."""
    scene = random_world()
    eye = np.array([0.4, -1.0, 0.3])
    direction = oracles.normalized(np.array([0.0, 0.1, 4.0]) - eye)
    found = found_on(scene, Ray(eye + 0.5 * direction, direction, path_length=0.5))
    expected = np.concatenate([oracles.sh_color(instance, eye, 3) for instance in scene.splats])
    np.testing.assert_allclose(found.color, expected[found.index], atol=1e-12)
    flat = np.concatenate([oracles.sh_color(instance, eye, 1) for instance in scene.splats])
    found = found_on(scene, Ray(eye, direction), sh_degree=1)
    np.testing.assert_allclose(found.color, flat[found.index], atol=1e-12)


# --- Blending ---


def layers(*opacities: float, colors: tuple[tuple[float, float, float], ...] = ()) -> Scene:
    """Returns Gaussians one behind the other from z = 3 on, listed from back to front."""
    given = colors or ((0.5, 0.5, 0.5),) * len(opacities)
    sets = [one_gaussian((0.0, 0.0, 3.0 + i), 0.3, a, c) for i, (a, c) in enumerate(zip(opacities, given, strict=True))]
    return Scene([joined(*sets[::-1])])


def test_two_hits_on_a_ray_blend_front_to_back() -> None:
    """The nearer hit occludes the farther; depth, index and normal are of the hit that passes transmittance 0.7."""
    scene = layers(0.25, 0.5, colors=((1.0, 0.0, 0.2), (0.0, 1.0, 0.4)))
    one = traced(scene)
    assert one.color == pytest.approx(0.25 * np.array([1.0, 0.0, 0.2]) + 0.375 * np.array([0.0, 1.0, 0.4]), abs=1e-6)
    assert one.alpha == pytest.approx(0.625, abs=1e-7)
    assert (one.depth, one.gaussian_index, one.instance_index) == (pytest.approx(4.0), 0, 0)
    assert one.normal == pytest.approx([0.0, 0.0, -1.0])
    over = traced(scene, background=(1.0, 1.0, 1.0))
    assert over.color == pytest.approx(one.color + 0.375, abs=1e-6)
    assert traced(scene, depth_iso_transmittance=0.8).gaussian_index == 1
    nothing = traced(scene, depth_iso_transmittance=0.1)
    assert (nothing.depth, nothing.gaussian_index, nothing.instance_index) == (np.inf, -1, -1)


def test_ray_ends_once_it_reaches_the_minimum_transmittance() -> None:
    """The Gaussian that brings transmittance down to 1e-4 is the last one."""
    scene = layers(0.9, 0.95, 0.985, 0.5, colors=((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)))
    assert traced(scene).color == pytest.approx([0.9, 0.095, 0.005 * 0.985], abs=1e-6)
    assert traced(scene).alpha == pytest.approx(1.0 - 0.005 * 0.015, abs=1e-6)
    assert traced(scene, transmittance_min=0.0).color[2] == pytest.approx(0.005 * (0.985 + 0.015 * 0.5), rel=1e-4)
    assert traced(scene, transmittance_min=0.2).color == pytest.approx([0.9, 0.0, 0.0])


def test_hits_at_equal_distances_keep_the_order_of_the_scene() -> None:
    """At equal distances, the first Gaussian of a set and the first instance are in front."""
    red, blue = one_gaussian(opacity=0.9, color=(1.0, 0.0, 0.0)), one_gaussian(opacity=0.9, color=(0.0, 0.0, 1.0))
    for scene in (Scene([joined(red, blue)]), Scene([red, blue])):
        one = traced(scene)
        assert one.color == pytest.approx([0.9, 0.0, 0.09], abs=1e-6)
        assert one.slack < 1e-4, "copies cannot change places"


def test_mean_of_nearly_opposite_hit_normals_becomes_the_direction_to_the_viewer() -> None:
    """A mean normal shorter than 0.2 is replaced by the direction to the viewer."""
    sheets = Scene([opposed_sheets()])
    found = found_on(sheets)
    assert found.normal[0] @ found.normal[1] < -0.9
    assert traced(sheets).normal == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)


def test_rays_that_miss_everything_show_the_background() -> None:
    """An empty scene, or a ray that misses everything, shows the background without a surface."""
    for scene in (Scene(), layers(0.5)):
        one = traced(scene, Ray(np.zeros(3), np.array([0.0, 0.0, -1.0])), background=(0.3, 0.3, 0.3))
        assert one.color == pytest.approx([0.3] * 3)
        assert (one.alpha, one.depth, one.gaussian_index, one.instance_index) == (0.0, np.inf, -1, -1)
        assert not one.normal.any()


# --- Random strategies ---


@pytest.mark.parametrize("strategy", [TraceStrategy.STOCHASTIC_HIT, TraceStrategy.STOCHASTIC_PASS])
@pytest.mark.parametrize("hits_per_pass", [4, 16])
@pytest.mark.parametrize("meshes", [[], [quad(4.0, 2.0, tilt=0.4)], [quad(4.2, 9.0, tilt=0.4, material=GLASS)]])
def test_expected_colour_of_stochastic_tracing_equals_the_colour_of_sorted_tracing(
    strategy: TraceStrategy, hits_per_pass: int, meshes: list[Mesh]
) -> None:
    """Stochastic expectations equal the sorted image with meshes, mirrors and glass, if sorting never stops early."""
    scene = Scene([random_gaussians(8, 300, degree=2)], meshes)
    rng = np.random.default_rng(1)
    for _ in range(20):
        ray = random_ray(rng)
        config = {"background": (0.7, 0.7, 0.7), "transmittance_min": 0.0, "hits_per_pass": hits_per_pass}
        expected = traced(scene, ray, **config)
        actual = traced(scene, ray, strategy=strategy, **config)
        # Sorted branches weigh less, so that more of them are dropped: below 1/512 each.
        np.testing.assert_allclose(actual.color, expected.color, atol=8.0 / 512.0 if meshes else 1e-12)
        assert actual.alpha == pytest.approx(expected.alpha, abs=1e-12)
        assert expected.color_variance == pytest.approx([0.0] * 3)


@pytest.mark.parametrize(
    "settings",
    [
        {"strategy": TraceStrategy.STOCHASTIC_HIT},
        {"strategy": TraceStrategy.STOCHASTIC_HIT, "acceptance_scale": 0.4},
        {"strategy": TraceStrategy.STOCHASTIC_PASS, "hits_per_pass": 4},
    ],
)
def test_mean_and_variance_of_stochastic_colours_by_the_oracle_equal_a_simulation(settings: dict) -> None:
    """Simulating a strategy 100,000 times gives the oracle's mean, variance and outcome frequencies."""
    scene = Scene([random_gaussians(8, 300, scale_range=(0.1, 0.4))], [quad(4.6, 2.0)])
    found = found_on(scene)
    found = picked(found, found.t < 4.6)
    assert len(found) > 8
    config = TraceConfig(**settings)
    rng, rounds = np.random.default_rng(2), 100_000
    if config.strategy is TraceStrategy.STOCHASTIC_HIT:
        accepted = rng.random((rounds, len(found))) * config.acceptance_scale < found.alpha
        values = found.color
    else:
        passes = [blend(picked(found, slice(i, i + 4)), 0.7) for i in range(0, len(found), 4)]
        accepted = rng.random((rounds, len(passes))) < [1.0 - one.transmittance for one in passes]
        values = np.stack([one.color / (1.0 - one.transmittance) for one in passes])
    winner = np.where(accepted.any(axis=1), accepted.argmax(axis=1), len(values))
    mesh_color = encode_srgb(np.full(3, 0.8))
    shown = np.concatenate([values, mesh_color[None]])[winner]

    one = traced(scene, **settings)
    error = np.sqrt(one.color_variance / rounds)
    assert (np.abs(shown.mean(axis=0) - one.color) < 4.5 * error).all()
    np.testing.assert_allclose(shown.var(axis=0), one.color_variance, rtol=0.03)
    may_show = outcomes(found, AXIS, config)
    chance = np.append(may_show.probability, may_show.nothing)
    counted = np.bincount(winner, minlength=len(chance)) / rounds
    assert (np.abs(counted - chance) < 4.5 * np.sqrt(chance * (1.0 - chance) / rounds) + 1e-9).all()
    assert one.alpha == 1.0


def test_depth_of_a_stochastic_pass_without_iso_surface_is_that_of_its_farthest_hit() -> None:
    """The surface of a pass is its iso-opacity hit from full transmittance, or its farthest hit if there is none."""
    config = TraceConfig(strategy=TraceStrategy.STOCHASTIC_PASS, hits_per_pass=4)
    found = found_on(layers(0.05, 0.05, 0.05, 0.05, 0.1, 0.1, 0.2, 0.1, 0.3))
    may_show = outcomes(found, AXIS, config)
    assert may_show.depth == pytest.approx([6.0, 9.0, 11.0])
    assert may_show.index.tolist() == [5, 2, 0]
    opacity = np.array([1.0 - 0.95**4, 1.0 - 0.9**3 * 0.8, 0.3])
    reached = np.array([1.0, 0.95**4, 0.95**4 * 0.9**3 * 0.8])
    assert may_show.probability == pytest.approx(reached * opacity, rel=1e-6)


def test_gaussians_coloured_like_the_background_are_invisible_in_every_tracing_strategy() -> None:
    """The law holds for all tracing strategies, without variance."""
    gaussians = random_gaussians(10, 300)
    uniform = replace(gaussians, sh=flat_sh(np.full((300, 3), 0.37)))
    rng = np.random.default_rng(0)
    for strategy in TraceStrategy:
        for _ in range(10):
            one = traced(Scene([uniform]), random_ray(rng), background=(0.37,) * 3, strategy=strategy)
            assert one.color == pytest.approx([0.37] * 3, abs=1e-6)
            assert one.color_variance == pytest.approx([0.0] * 3, abs=1e-12)


# --- Effects of rounding ---


def shaken(gaussians: Gaussians, seed: int) -> Gaussians:
    """Moves the means by one rounding error."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], gaussians.means.shape)
    return replace(gaussians, means=gaussians.means * (1.0 + signs * 2.0**-23))


@pytest.mark.parametrize("settings", [{}, {"hit_distance": HitDistance.HULL, "normal_method": NormalMethod.ELLIPSOID}])
def test_error_bound_of_the_oracle_covers_float32_rounding_of_its_inputs(settings: dict) -> None:
    """Moving inputs by a rounding error changes colour, normal and distance by at most the oracle's ``slack``."""
    needles = random_gaussians(11, 150, degree=1, scale_range=(1e-6, 0.8))
    camera = front_camera(20, 15, 20.0)
    first, second = (
        trace_oracle.render(Scene([one], [quad(4.0, tilt=0.7)]), camera, trace_config(**settings))
        for one in (needles, shaken(needles, 6))
    )
    difference = np.abs(first["color"] - second["color"]).max(axis=-1)
    assert (difference <= first["slack"] + 1e-6).all()
    assert difference.max() > 1e-6, "the example must be sensitive"
    assert np.median(first["slack"]) < 1e-4
    turned = np.abs(first["normal"] - second["normal"]).max(axis=-1)
    assert (turned <= first["normal_slack"] + 1e-6).all()
    sure = ~first["band"]
    assert sure.mean() > 0.9
    np.testing.assert_array_equal(first["gaussian_index"][sure], second["gaussian_index"][sure])
    sure &= np.isfinite(first["depth"])
    shift = np.abs(first["depth"][sure] - second["depth"][sure])
    assert (shift <= first["depth_slack"][sure] + 1e-6).all()


def test_error_bound_of_the_oracle_lets_a_ray_miss_a_needle_thinner_than_rounding() -> None:
    """The oracle's ``slack`` covers a miss, even if the ray is aimed at the needle's centre."""
    needle = one_gaussian((0.1, 0.2, 4.0), (1.0, 1e-6, 1e-6), 0.8)
    through = Ray(np.zeros(3), oracles.normalized(needle.means[0].astype(float)))
    assert traced(Scene([needle]), through).slack > 0.5
    assert traced(Scene([one_gaussian((0.1, 0.2, 4.0), (1.0, 1e-3, 1e-3), 0.8)]), through).slack < 1e-3


def test_error_bound_of_the_oracle_covers_swaps_of_hits_closer_than_rounding() -> None:
    """The oracle's ``slack`` allows two close Gaussians in either order, and ``band`` either surface."""
    red, blue = one_gaussian((0.0, 0.0, 4.0), 0.2, 0.8, (1, 0, 0)), one_gaussian((0.0, 0.0, 4.0), 0.3, 0.5, (0, 0, 1))
    for gap, slack, band in ((0.0, 0.4, True), (4e-7, 0.4, True), (1e-4, 0.0, False)):
        behind = replace(blue, means=blue.means + np.array([0.0, 0.0, gap], np.float32))
        one = traced(Scene([joined(red, behind)]))
        assert one.slack == pytest.approx(slack, abs=1e-3)
        assert one.band == band


def test_error_bound_of_the_oracle_covers_values_that_may_round_across_a_threshold() -> None:
    """An alpha of 1/255, a peak at the ray's start and a transmittance at a threshold may round either way."""
    faint = one_gaussian((0.0, 0.0, 4.0), opacity=1.0 / 255.0)
    assert traced(Scene([faint])).slack == pytest.approx(1.0 / 255.0, rel=1e-3)
    half = Scene([one_gaussian((0.0, 0.0, 4.0), opacity=0.5)])
    assert traced(half, replace(AXIS, t_min=4.0)).slack == pytest.approx(0.5, rel=1e-3)
    assert traced(half, replace(AXIS, t_min=3.99)).slack < 1e-4
    assert traced(half, depth_iso_transmittance=0.5).band
    assert not traced(half, depth_iso_transmittance=0.501).band
    assert traced(half, transmittance_min=0.5).slack == pytest.approx(0.5)
    near_mesh = replace(half, meshes=(MeshInstance(quad(4.0)),))
    assert traced(near_mesh).slack == np.inf, "the axis passes the diagonal of the quad"
    off_axis = Ray(np.array([0.01, -0.02, 0.0]), AXIS.direction)
    assert traced(near_mesh, off_axis).slack == pytest.approx(0.5, rel=0.02)
