"""Shadow rays through Gaussians and glass: closed forms, the float64 reference, and stochastic shadows."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import ShadowMethod
from lumisplat.demo.shapes import icosphere
from lumisplat.math.color import decode_srgb
from lumisplat.renderer.shadow import shadow_rays
from support.files.splat_files import load_gaussians
from support.oracles import shadow_oracle
from support.oracles.raster_oracle import normalized
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import checker_quad, joined, one_gaussian, quad, random_gaussians, similarity
from support.scenes.shadow_rig import SCHEDULES, ShadowRig
from support.scenes.trace_scenes import copies, placed_scene

AHEAD = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)
FIRST, STOCHASTIC = ShadowMethod.FIRST_HITS, ShadowMethod.STOCHASTIC


@pytest.fixture(params=SCHEDULES)
def rig(request: pytest.FixtureRequest) -> ShadowRig:
    """Returns a rig of shadow rays for a device and a schedule."""
    return ShadowRig(request.param)


def stack(*opacities: float, color: tuple[float, float, float] = (0.9, 0.5, 0.1)) -> ls.Gaussians:
    """Returns Gaussians centred on the axis at z = 3, 4, 5 and so on."""
    parts = [one_gaussian((0.0, 0.0, 3.0 + i), opacity=opacity, color=color) for i, opacity in enumerate(opacities)]
    return joined(*parts)


def glass(**changes: Any) -> ls.MaterialPbr:
    """Returns white glass without reflection; ``changes`` replace fields of the material."""
    clear = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.0, transmission=1.0, specular=0.0)
    return replace(clear, **changes)


def rays_around(seed: int, count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Returns rays from all sides through the region of (0, 0, 4), half in coherent packets, half incoherent."""
    rng = np.random.default_rng(seed)
    origins = np.array([0.0, 0.0, 4.0]) + rng.normal(0.0, 2.0, (count, 3))
    targets = np.array([0.0, 0.0, 4.0]) + rng.normal(0.0, 0.8, (count, 3))
    half = count // 2
    origins[:half] = np.repeat(origins[: half // 20], 20, axis=0) + rng.normal(0.0, 0.01, (half, 3))
    targets[:half] = np.repeat(targets[: half // 20], 20, axis=0) + rng.normal(0.0, 0.1, (half, 3))
    return origins.astype(np.float32), normalized(targets - origins).astype(np.float32)


def assert_matches_reference(
    rig: ShadowRig, scene: ls.Scene, config: ls.RenderConfig | None = None, seed: int = 1, **shadow: Any
) -> np.ndarray:
    """Compares random rays with random offsets and light distances to float64; returns the light that arrived."""
    config = config or ls.RenderConfig()
    origins, along = rays_around(seed)
    rng = np.random.default_rng(seed + 100)
    t_min = rng.choice([0.0, 0.3], len(origins)) * rng.random(len(origins))
    t_max = np.where(rng.random(len(origins)) < 0.5, rng.uniform(1.0, 4.0, len(origins)), np.inf)
    t_min, t_max = t_min.astype(np.float32), t_max.astype(np.float32)
    found = rig.light(scene, origins, along, config, t_min=t_min, t_max=t_max, **shadow)
    reference_config = replace(config, shadow_rays=ls.ShadowConfig(**shadow))
    expected = shadow_oracle.light(scene, origins, along, reference_config, t_min=t_min, t_max=t_max)
    certain = np.isfinite(expected.slack)
    assert certain.mean() > 0.8
    off = np.abs(found - expected.color).max(axis=1)[certain]
    worst = int((off - expected.slack[certain]).argmax())
    assert (off <= expected.slack[certain] + 2e-5).all(), f"ray {np.flatnonzero(certain)[worst]} is off by {off[worst]}"
    assert 0.1 < (found[:, 0] < 0.99).mean() < 1.0
    return found


# --- The product over all Gaussians ---


def test_transmittance_of_a_shadow_ray_is_the_product_over_its_gaussians(rig: ShadowRig) -> None:
    """Only Gaussians between the point and the light count."""
    t_max = np.array([2.9, 3.1, 4.1, 5.1, 1e9, np.inf])
    light = rig.light(ls.Scene([stack(0.5, 0.8, 0.3)]), np.zeros((6, 3)), AHEAD, t_max=t_max)
    np.testing.assert_allclose(light, np.outer([1.0, 0.5, 0.1, 0.07, 0.07, 0.07], np.ones(3)), rtol=1e-5)


def test_shadow_ray_skips_gaussians_whose_response_peaks_before_the_start_of_the_ray(rig: ShadowRig) -> None:
    """A ray that ends before ``t_min`` hits no Gaussian."""
    t_min = np.array([0.0, 3.1, 4.1, 9.0, 3.1])
    t_max = np.array([np.inf, np.inf, np.inf, np.inf, 2.0])
    scene = ls.Scene([stack(0.5, 0.8)])
    light = rig.light(scene, np.zeros((5, 3)), AHEAD, t_min=t_min, t_max=t_max, offset=100.0)
    np.testing.assert_allclose(light[:, 0], [0.1, 0.2, 1.0, 1.0, 1.0], rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_transmittance_of_shadow_rays_matches_the_float64_reference(rig: ShadowRig, degree: int) -> None:
    """Anisotropic Gaussians of several degrees and transforms are hit by coherent and by single rays."""
    placed = placed_scene()
    scene = ls.Scene([*placed.splats, replace(random_gaussians(7, 60), kernel_degree=degree)])
    assert_matches_reference(rig, scene, seed=10 + degree)


@pytest.mark.parametrize("response", [{"min_response": 0.2}, {"kernel_degree": 5}])
def test_minimum_response_and_kernel_degree_apply_to_shadow_rays_as_to_camera_rays(
    rig: ShadowRig, response: dict[str, Any]
) -> None:
    """Shadows match the float64 reference with another minimum response and with another kernel degree."""
    assert_matches_reference(
        rig, placed_scene(), ls.RenderConfig(response=ls.config.ResponseConfig(**response)), seed=20
    )


def test_hit_distance_setting_does_not_change_the_transmittance_of_shadow_rays(rig: ShadowRig) -> None:
    """All Gaussians that peak before the light count, whatever ``hit_distance`` is."""
    assert_matches_reference(rig, placed_scene(), seed=20, hit_distance=ls.config.HitDistance.HULL)


def test_tracer_and_rasteriser_settings_do_not_affect_shadow_rays(rig: ShadowRig) -> None:
    """The bits are equal for exact shadows and for shadows of the first hits."""
    trace = ls.TraceConfig(hit_distance=ls.config.HitDistance.HULL, transmittance_min=0.5, hits_per_pass=4, sh_degree=0)
    others = ls.RenderConfig(trace=trace, raster=ls.RasterConfig(transmittance_min=0.5))
    shadows: list[dict[str, Any]] = [{"color_strength": 1.0}, {"method": FIRST, "hits": 4}]
    for shadow in shadows:
        plain, same = (rig.light(placed_scene(), *rays_around(22), config, **shadow) for config in (None, others))
        np.testing.assert_array_equal(plain, same)


def test_transmittance_of_shadow_rays_does_not_depend_on_gaussian_order(rig: ShadowRig) -> None:
    """Transmittance and tint do not depend on how Gaussians are split into instances, either."""
    whole = random_gaussians(30, 300)
    shuffled = whole.subset(np.random.default_rng(1).permutation(300))
    parts = [whole.subset(np.arange(start, 300, 3)) for start in range(3)]
    origins, along = rays_around(31)
    first, *others = (
        rig.light(ls.Scene(splats), origins, along, color_strength=2.0) for splats in ([whole], [shuffled], parts)
    )
    assert first.std() > 0.2 and (first[:, 0] != first[:, 2]).mean() > 0.2
    for other in others:
        np.testing.assert_allclose(other, first, atol=5e-6)


def test_shadow_rays_below_the_minimum_transmittance_are_black(rig: ShadowRig) -> None:
    """Above ``transmittance_min``, the product is exact; a minimum of 0 means no limit."""
    scene = ls.Scene([stack(0.95, 0.95, 0.95)])
    for least, expected in ((1e-4, 0.05**3), (1.2e-4, 0.05**3), (1.3e-4, 0.0), (0.0, 0.05**3)):
        light = rig.light(scene, ORIGIN, AHEAD, transmittance_min=least)[0]
        assert light == pytest.approx(np.full(3, expected), rel=1e-4)


def test_shadow_rays_do_not_depend_on_thread_count() -> None:
    """The bits are equal with 1 and 3 threads."""
    origins, along = rays_around(40)
    scene = placed_scene()
    shadows: list[dict[str, Any]] = [{"color_strength": 1.0}, {"method": FIRST, "hits": 4}, {"method": STOCHASTIC}]
    for shadow in shadows:
        one, three = (ShadowRig("cpu", threads).light(scene, origins, along, **shadow) for threads in (1, 3))
        np.testing.assert_array_equal(one, three)


# --- Threshold and tint ---


def test_shadow_rays_map_transmittance_from_threshold_to_1_linearly_to_0_to_1(rig: ShadowRig) -> None:
    """Light is black up to the threshold, unchanged where nothing blocks the ray, and linear between."""
    light = rig.light(
        ls.Scene([stack(0.2, 0.5, 0.5)]),
        np.zeros((4, 3)),
        AHEAD,
        t_max=[2.5, 3.5, 4.5, 5.5],
        transmittance_threshold=0.25,
    )
    np.testing.assert_allclose(light[:, 1], [1.0, (0.8 - 0.25) / 0.75, (0.4 - 0.25) / 0.75, 0.0], rtol=1e-5)


@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0, 5.0])
def test_tint_of_a_shadow_ray_by_one_gaussian_matches_the_closed_form(rig: ShadowRig, strength: float) -> None:
    """The Gaussian filters what passes by its colour, and transmits its colour of what it blocks, by strength / 5."""
    color = (0.8, 0.4, 0.2)
    light = rig.light(ls.Scene([stack(0.6, color=color)]), ORIGIN, AHEAD, color_strength=strength)[0]
    linear = decode_srgb(np.array(color))
    filtered = 0.4 * (1.0 + min(0.6 * strength, 1.0) * (linear / linear.max() - 1.0))
    np.testing.assert_allclose(light, filtered + 0.6 * strength / 5.0 * linear, rtol=1e-5)


@pytest.mark.parametrize("strength", [0.0, 1.0, 5.0])
def test_opaque_gaussians_tint_the_light_that_they_block(rig: ShadowRig, strength: float) -> None:
    """Behind 60 opaque Gaussians, each ray receives their mean colour times strength / 5, never more than it blocks."""
    layers = [stack(0.99, color=color) for color in ((0.9, 0.2, 0.2), (0.2, 0.3, 0.9))]
    scene = ls.Scene([ls.SplatInstance(layers[i % 2], similarity(offset=(0.0, 0.0, 0.1 * i))) for i in range(60)])
    light = rig.light(scene, ORIGIN, AHEAD, color_strength=strength)[0]
    mean = decode_srgb(np.array([[0.9, 0.2, 0.2], [0.2, 0.3, 0.9]])).mean(axis=0)
    np.testing.assert_allclose(light, strength / 5.0 * mean, rtol=1e-4)


def test_tint_of_a_shadow_ray_is_the_mean_gaussian_colour_weighted_by_alpha(rig: ShadowRig) -> None:
    """Two Gaussians have different colours and opacities, in either order; black Gaussians do not tint."""
    red, green = (stack(opacity, color=c) for opacity, c in ((0.6, (1.0, 0.0, 0.0)), (0.3, (0.0, 1.0, 0.0))))
    away = similarity(offset=(0.0, 0.0, 1.0))
    for splats in ([red, ls.SplatInstance(green, away)], [green, ls.SplatInstance(red, away)]):
        light = rig.light(ls.Scene(splats), ORIGIN, AHEAD, color_strength=1.0)[0]
        share = 1.0 - 0.28
        filtered = 0.28 * np.array([1.0, 1.0 - share * 0.5, 1.0 - share])
        np.testing.assert_allclose(light, filtered + share / 5.0 * np.array([2.0, 1.0, 0.0]) / 3.0, rtol=1e-4)
    black = rig.light(ls.Scene([stack(0.5, color=(0.0, 0.0, 0.0))]), ORIGIN, AHEAD, color_strength=5.0)[0]
    np.testing.assert_allclose(black, 0.5, rtol=1e-5)


def test_tint_and_threshold_of_shadow_rays_match_the_float64_reference(rig: ShadowRig) -> None:
    """Tint and threshold are combined, on random scenes."""
    found = assert_matches_reference(rig, placed_scene(), seed=50, color_strength=1.5, transmittance_threshold=0.3)
    assert (np.ptp(found, axis=1) > 0.05).mean() > 0.1


# --- The first hits only ---


@pytest.mark.parametrize("reverse", [False, True])
def test_shadow_rays_by_the_first_hits_method_are_blocked_by_the_nearest_four_gaussians(
    rig: ShadowRig, reverse: bool
) -> None:
    """Product and tint are those of the nearest four in any storage order; further Gaussians do not block."""
    six = stack(0.1, 0.2, 0.3, 0.4, 0.9, 0.9)
    scene = ls.Scene([six.subset(np.arange(5, -1, -1)) if reverse else six])
    light = rig.light(scene, ORIGIN, AHEAD, method=FIRST, hits=4)[0]
    np.testing.assert_allclose(light, 0.9 * 0.8 * 0.7 * 0.6, rtol=1e-5)
    tinted = joined(stack(0.5, 0.5, 0.5, 0.5, color=(0.2, 0.2, 0.9)), one_gaussian((0, 0, 8), color=(0.9, 0.0, 0.0)))
    blue = rig.light(ls.Scene([tinted]), ORIGIN, AHEAD, method=FIRST, hits=4, color_strength=1.0)[0]
    color = decode_srgb(np.array([0.2, 0.2, 0.9]))
    filtered = 0.0625 * (1.0 - 0.9375 * (1.0 - color / color.max()))
    np.testing.assert_allclose(blue, filtered + 0.9375 / 5.0 * color, rtol=1e-4)


def test_shadow_method_first_hits_orders_hits_at_equal_distance_by_gaussian_index(rig: ShadowRig) -> None:
    """The Gaussians are coincident copies."""
    same = copies(12, 60)
    aim = normalized(np.array([0.1, -0.2, 4.0]))
    light = rig.light(ls.Scene([same]), ORIGIN, aim, method=FIRST, hits=8)[0]
    np.testing.assert_allclose(light, np.prod(1.0 - same.opacities[:8].astype(float)), rtol=1e-4)


def test_shadows_by_the_first_hits_method_are_never_darker_than_exact_shadows(rig: ShadowRig) -> None:
    """Gaussians beyond the limit do not darken; rays that cross few Gaussians count all of them."""
    origins, along = rays_around(61)
    scene = ls.Scene([random_gaussians(62, 400)])
    exact = rig.light(scene, origins, along)[:, 0]
    few, many = (rig.light(scene, origins, along, method=FIRST, hits=hits)[:, 0] for hits in (4, 32))
    rounding = 0.004  # at the edge of a Gaussian, where alpha is 1/255
    assert (few >= exact - rounding).all() and (few > exact + 0.05).mean() > 0.1
    np.testing.assert_allclose(many, exact, atol=rounding)
    assert (np.abs(many - exact) < 2e-6).mean() > 0.99
    assert_matches_reference(rig, placed_scene(), seed=63, method=FIRST, hits=4)
    assert_matches_reference(
        rig, placed_scene(), seed=64, method=FIRST, hits=4, hit_distance=ls.config.HitDistance.HULL
    )


# --- Meshes ---


def test_triangle_between_point_and_light_blocks_shadow_rays_from_both_sides(rig: ShadowRig) -> None:
    """A triangle behind the light does not block it."""
    scene = ls.Scene([stack(0.5)], [quad(4.0)])
    t_max = [2.0, 3.5, 4.5, np.inf]
    np.testing.assert_allclose(
        rig.light(scene, np.zeros((4, 3)), AHEAD, t_max=t_max)[:, 0], [1.0, 0.5, 0.0, 0.0], atol=1e-6
    )
    assert rig.light(scene, 8.0 * AHEAD, -AHEAD, t_max=3.9)[0, 0] == 1.0
    assert rig.light(scene, 8.0 * AHEAD, -AHEAD, t_max=4.1)[0, 0] == 0.0


def test_shadow_offset_of_gaussians_does_not_apply_to_meshes(rig: ShadowRig) -> None:
    """A wall nearer than the offset blocks light, even if the light is nearer than the offset, too."""
    scene = ls.Scene([stack(0.5)], [quad(1.0)])
    light = rig.light(scene, np.zeros((3, 3)), AHEAD, t_min=[2.0, 2.0, 0.0], t_max=[np.inf, 1.5, 0.9])
    np.testing.assert_array_equal(light[:, 0], [0.0, 0.0, 1.0])


def test_smooth_glass_transmits_and_tints_shadow_rays(rig: ShadowRig) -> None:
    """Transmission, tint, Fresnel's 4 % times specular, and 1 - metallic are applied; rough glass transmits nothing."""
    for changes, expected in (
        ({}, (1.0, 1.0, 1.0)),
        ({"base_color": (0.5, 0.25, 1.0)}, (0.5, 0.25, 1.0)),
        ({"transmission": 0.5}, (0.5, 0.5, 0.5)),
        ({"specular": 1.0}, (0.96, 0.96, 0.96)),
        ({"specular": 0.5, "ior": 3.0}, (0.875, 0.875, 0.875)),
        ({"metallic": 0.25}, (0.75, 0.75, 0.75)),
        ({"roughness": 0.01}, (0.0, 0.0, 0.0)),
        ({"transmission": 0.0}, (0.0, 0.0, 0.0)),
        ({"metallic": 1.0}, (0.0, 0.0, 0.0)),
    ):
        scene = ls.Scene([], [quad(4.0, material=glass(**changes))])
        np.testing.assert_allclose(rig.light(scene, [0.3, 0.1, 0.0], AHEAD)[0], expected, atol=1e-6)


def test_shadow_rays_through_a_glass_pane_lose_the_same_fraction_at_both_faces(rig: ShadowRig) -> None:
    """Light passes straight: both faces use Fresnel's reflectance of air to glass, and a slab transmits the square."""
    material = glass(specular=1.0)
    slanted = normalized(np.array([0.9, 0.1, 0.3]))
    cosine = float(slanted[2])
    beyond = math.sqrt(1.0 - (1.0 - cosine**2) / 2.25)
    across, along = (cosine - 1.5 * beyond) / (cosine + 1.5 * beyond), (1.5 * cosine - beyond) / (1.5 * cosine + beyond)
    passed = 1.0 - 0.5 * (across**2 + along**2)
    front, back = quad(1.0, 9.0, material=material), quad(1.2, 9.0, material=material)
    inside_out = replace(back, indices=back.indices[:, ::-1])
    light = rig.light(ls.Scene([], [front, inside_out]), ORIGIN, slanted)[0]
    np.testing.assert_allclose(light, passed**2, rtol=1e-5)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
def test_transmittances_of_coloured_panes_multiply_in_any_order(rig: ShadowRig, order: list[int]) -> None:
    """Coloured panes are separate instances or one mesh; a wall among the panes blocks all light."""
    colors = ((0.5, 1.0, 0.8), (0.9, 0.2, 0.5), (0.7, 0.6, 0.5))
    panes = [quad(2.0 + i, material=glass(base_color=colors[i])) for i in order]
    light = rig.light(ls.Scene([], panes), [0.3, 0.1, 0.0], AHEAD)[0]
    np.testing.assert_allclose(light, np.prod(colors, axis=0), rtol=1e-5)
    one = ls.Mesh(
        np.concatenate([pane.positions for pane in panes]),
        np.concatenate([pane.indices + 4 * i for i, pane in enumerate(panes)]),
        material=glass(base_color=(0.5, 0.6, 0.7)),
    )
    np.testing.assert_allclose(
        rig.light(ls.Scene([], [one]), [0.3, 0.1, 0.0], AHEAD)[0], np.power([0.5, 0.6, 0.7], 3), rtol=1e-5
    )
    for meshes in ([quad(3.5), *panes], [*panes, quad(3.5)], [panes[0], quad(1.0), *panes[1:]]):
        assert (rig.light(ls.Scene([], meshes), [0.3, 0.1, 0.0], AHEAD) == 0.0).all()


def test_shadow_rays_through_edges_and_corners_of_a_pane_hit_exactly_one_triangle(rig: ShadowRig) -> None:
    """The law holds for any winding order."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    points = np.stack([x.ravel(), y.ravel(), np.full(25, 3.0)], axis=-1)
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, 5]), np.add(corner, [1, 6, 5])])
    for indices in (faces, faces[:, ::-1], np.concatenate([faces[:7, ::-1], faces[7:]])):
        pane = ls.Mesh(points, indices, material=glass(base_color=(0.5, 0.5, 0.5)))
        steps = np.arange(0.5, 3.6, 0.5)  # corners, and midpoints of edges and diagonals
        origins = np.array([(u, v, 0.0) for u in steps for v in steps])
        for along in (AHEAD, -AHEAD):
            start = origins if along[2] > 0.0 else origins + 6.0 * AHEAD
            np.testing.assert_allclose(rig.light(ls.Scene([], [pane]), start, along), 0.5, rtol=1e-6)


def test_shadow_rays_cross_a_closed_glass_sphere_an_even_number_of_times(rig: ShadowRig) -> None:
    """Rays are aimed at vertices, edges and faces of the sphere; each enters and leaves."""
    sphere = icosphere(1.0, subdivisions=2)
    ball = ls.Mesh(sphere.positions, sphere.indices, material=glass(base_color=(0.5, 0.5, 0.5)))
    rng = np.random.default_rng(70)
    faces = ball.indices[rng.integers(0, ball.face_count, 600)]
    weights = rng.dirichlet((1.0, 1.0, 1.0), 600)
    weights[200:400, 0] = 0.0
    weights[400:] = [1.0, 0.0, 0.0]
    weights /= weights.sum(axis=1, keepdims=True)
    aims = 0.999 * np.einsum("nk,nkc->nc", weights, ball.positions[faces].astype(float))
    origins = np.array([0.3, -4.0, 0.2])
    light = rig.light(ls.Scene([], [ball]), origins, normalized(aims - origins))[:, 0]
    crossings = np.log(light) / math.log(0.5)
    np.testing.assert_allclose(crossings % 2.0, np.round(crossings) % 2.0, atol=1e-4)
    assert (np.round(crossings) == 2).mean() > 0.99 and (np.round(crossings) % 2 == 0).all()


def test_shadow_rays_through_glass_and_gaussians_match_the_reference(rig: ShadowRig) -> None:
    """Panes are textured, tilted, sheared and mirrored, among Gaussians."""
    tilted = quad(4.5, 1.4, tilt=0.8, material=glass(base_color=(0.9, 0.6, 0.4), specular=0.8, ior=1.8))
    board = checker_quad(0.0)
    textured = replace(board, material=glass(base_color_texture=board.material.base_color_texture, metallic=0.3))
    sheared = similarity((1.0, 2.0, 0.5), 0.7, 0.9, (0.1, 0.2, 3.8)) @ np.diag([1.0, -1.3, 1.0, 1.0])
    meshes = [tilted, ls.MeshInstance(textured, sheared), ls.MeshInstance(quad(0.0, 0.6), similarity(offset=(1, 1, 4)))]
    assert_matches_reference(rig, ls.Scene([random_gaussians(71, 60)], meshes), seed=72, color_strength=1.0)


def test_shadow_rays_with_opaque_shadows_are_blocked_by_glass(rig: ShadowRig) -> None:
    """With ``opaque``, every mesh blocks."""
    scene = ls.Scene([stack(0.5)], [quad(4.0, material=glass())])
    assert rig.light(scene, ORIGIN, AHEAD)[0, 0] == pytest.approx(0.5, rel=1e-5)
    assert rig.light(scene, ORIGIN, AHEAD, opaque=True)[0, 0] == 0.0


# --- Rays that do not see everything, and those that are none ---


def test_shadow_rays_that_skip_shadow_catchers_hit_all_other_objects(rig: ShadowRig) -> None:
    """Other rays of the packet hit the catchers, too."""
    scene = ls.Scene(
        [
            ls.SplatInstance(stack(0.5), shadow_catcher=True),
            ls.SplatInstance(stack(0.8), similarity(offset=(0.0, 0.0, 1.0))),
        ],
        [quad(9.0)],
    )
    skips = np.arange(48) % 3 == 0
    for method in ShadowMethod:
        light = rig.light(scene, np.zeros((48, 3)), AHEAD, skips=skips, t_max=8.0, method=method, hits=4)[:, 0]
        if method is not STOCHASTIC:
            np.testing.assert_allclose(light, np.where(skips, 0.2, 0.1), rtol=1e-5)
    alone = ls.Scene([ls.SplatInstance(stack(0.5), shadow_catcher=True)])
    assert (rig.light(alone, np.zeros((16, 3)), AHEAD, skips=1) == 1.0).all()


def test_inactive_nan_and_zero_length_shadow_rays_give_no_nan_in_any_ray(rig: ShadowRig) -> None:
    """Degenerate rays are inactive, NaN, or have the light at their origin."""
    scene = ls.Scene([stack(0.5)], [quad(5.0, material=glass())])
    t_max = np.tile([4.0, -np.inf, 0.0, -1.0, np.inf, np.nan, 4.0, np.inf], 4)
    origins = np.zeros((32, 3))
    along = np.tile(AHEAD, (32, 1))
    along[[1, 12, 14]] = 0.0
    origins[[6, 7]] = np.nan
    along[[15, 22]] = np.nan
    for method in ShadowMethod:
        light = rig.light(
            scene, origins, along, t_max=t_max, method=method, hits=4, color_strength=1.0, transmittance_threshold=0.1
        )
        assert np.isfinite(light).all()
        if method is not STOCHASTIC:
            expected = 4.0 / 9.0 + 5.0 / 9.0 * decode_srgb(0.9) / 5.0
            np.testing.assert_allclose(light[::8, 0], expected, rtol=1e-5)
    assert (rig.light(ls.Scene(), origins, AHEAD) == 1.0).all()


# --- By chance ---


def chances(rig: ShadowRig, scene: ls.Scene, rays: Any, samples: int, **options: Any) -> np.ndarray:
    """Returns the fraction of samples in which light arrives, one value per ray; each sample is 0 or 1."""
    total = np.zeros(len(rays[0]))
    for sample in range(samples):
        light = rig.light(scene, *rays, sample=sample, method=STOCHASTIC, **options)
        assert np.isin(light, (0.0, 1.0)).all()
        total += light[:, 0]
    return total / samples


SHARED = pytest.mark.parametrize("shared", [False, True], ids=["per ray", "shared"])
"""Parameter: random numbers per ray, or one number per Gaussian that all rays share."""


@SHARED
@pytest.mark.parametrize("degree", [0, 2, pytest.param(3, marks=pytest.mark.deep)])
def test_mean_transmittance_of_stochastic_shadow_rays_equals_that_of_exact_ones(
    rig: ShadowRig, degree: int, shared: bool
) -> None:
    """Each ray is within four standard deviations, the mean over rays within less; instances share BVHs."""
    asset = replace(random_gaussians(80, 80, center=(0.0, 0.0, 0.0)), kernel_degree=degree)
    scene = ls.Scene([asset, ls.SplatInstance(asset, similarity((1, 2, 0.5), 1.1, 1.2, (0.3, 0.1, 4.0))), stack(0.5)])
    rays = rays_around(81, 200)
    exact = rig.light(scene, *rays)[:, 0]
    samples = 256
    mean = chances(rig, scene, rays, samples, shared_draws=shared)
    sigma = np.sqrt(exact * (1.0 - exact) / samples)
    if shared:
        assert (np.abs(mean - exact) <= 4.0 * sigma + 1e-6).mean() > 0.995
        assert (np.abs(mean - exact) <= 5.0 * sigma + 2.0 / samples).all()
        assert abs(float(np.mean(mean - exact))) < 0.02
    else:
        # A ray's random numbers are stratified, one in each 256th, so the mean is exact to 1/256.
        assert (np.abs(mean - exact) <= 1.0 / samples + 1e-5).all()
        assert abs(float(np.mean(mean - exact))) < 4.0 / samples / math.sqrt(len(exact))


def test_neighbouring_stochastic_shadow_rays_use_independent_random_numbers(rig: ShadowRig) -> None:
    """Of many equal rays, half pass in each sample, uncorrelated with their neighbours.

    With shared numbers, all of them pass, or none.
    """
    count = 64 * 64
    scene, rays = ls.Scene([stack(0.5)]), (np.zeros((count, 3)), AHEAD)
    limit = 4.0 / math.sqrt(count)
    passed = [rig.light(scene, *rays, sample=sample, method=STOCHASTIC)[:, 0] for sample in (0, 1, 16)]
    for light in passed:
        assert light.mean() == pytest.approx(0.5, abs=0.5 * limit)
        for step in (1, 2, 3, 4, 16, 64):  # in a packet, in the next one, and in other rows
            assert abs(np.corrcoef(light[:-step], light[step:])[0, 1]) < limit
    # Numbers 0 and 1 of a sequence lie in different halves; those of other pairs are independent.
    np.testing.assert_array_equal(passed[0] + passed[1], 1.0)
    assert abs(np.corrcoef(passed[0], passed[2])[0, 1]) < limit
    shared = rig.light(scene, *rays, method=STOCHASTIC, shared_draws=True)
    assert np.ptp(shared) == 0.0


@SHARED
def test_acceptance_scale_raises_the_probability_that_a_gaussian_blocks_a_shadow_ray(
    rig: ShadowRig, shared: bool
) -> None:
    """Each Gaussian blocks with the probability min(1, alpha / scale), so the mean is darker by a known amount."""
    pane = stack(0.3, 0.2)
    scene, rays = ls.Scene([pane]), (np.zeros((16, 3)), AHEAD)
    sigma = math.sqrt(0.24 / 256)
    for scale, expected in ((1.0, 0.7 * 0.8), (0.5, 0.4 * 0.6), (0.25, 0.0)):
        mean = chances(rig, scene, rays, 256, acceptance_scale=scale, shared_draws=shared)
        assert mean == pytest.approx(expected, abs=4.0 * sigma)
    config = ls.RenderConfig(shadow_rays=ls.ShadowConfig(method=STOCHASTIC, acceptance_scale=0.4))
    scene, rays = ls.Scene([random_gaussians(93, 100)]), rays_around(94, 120)
    reference = shadow_oracle.light(scene, *rays, config)
    mean = chances(rig, scene, rays, 256, acceptance_scale=0.4, shared_draws=shared)
    deviation = np.sqrt(np.maximum(reference.color[:, 0] * (1.0 - reference.color[:, 0]), 0.0) / 256)
    certain = reference.slack < 1e-3
    assert certain.mean() > 0.9
    assert (np.abs(mean - reference.color[:, 0]) <= 5.0 * deviation + 2.0 / 256)[certain].all()


@pytest.mark.parametrize("samples", [256, pytest.param(1024, marks=pytest.mark.deep)])
@pytest.mark.parametrize("other", ["same set twice", "two sets"])
@SHARED
def test_coincident_gaussians_block_stochastic_shadow_rays_independently_of_each_other(
    rig: ShadowRig, shared: bool, other: str, samples: int
) -> None:
    """The two Gaussians of alpha 0.5 transmit a quarter of the light, not half."""
    pane = stack(0.5)
    scene = ls.Scene([pane, pane if other == "same set twice" else stack(0.5)])
    sigma = math.sqrt(0.25 * 0.75 / samples)
    mean = chances(rig, scene, (np.zeros((1, 3)), AHEAD), samples, shared_draws=shared)[0]
    assert mean == pytest.approx(0.25, abs=4.0 * sigma)


@SHARED
def test_sixteen_stochastic_shadow_samples_estimate_a_gaussians_alpha_to_one_sixteenth(
    rig: ShadowRig, shared: bool
) -> None:
    """Sixteen samples of one Gaussian estimate its alpha with an error below one sample."""
    for opacity in (0.1, 0.5, 0.77):
        through = chances(rig, ls.Scene([stack(opacity)]), (np.zeros((1, 3)), AHEAD), 16, shared_draws=shared)[0]
        assert abs(16.0 * through - 16.0 * (1.0 - opacity)) < 1.0


def test_stochastic_shadows_differ_by_seed_and_by_sample(rig: ShadowRig) -> None:
    """Equal seeds and sample indices give equal shadows."""
    scene, rays = ls.Scene([random_gaussians(82, 200)]), rays_around(83)

    def shadows(seed: int, sample: int) -> np.ndarray:
        return rig.light(scene, *rays, ls.RenderConfig(seed=seed), sample=sample, method=STOCHASTIC)[:, 0]

    first = shadows(0, 0)
    np.testing.assert_array_equal(first, shadows(0, 0))
    for seed, sample in ((1, 0), (0, 1), (0, 16)):
        assert 0.1 < (first != shadows(seed, sample)).mean() < 0.6


def test_cpu_and_cuda_schedules_draw_the_same_stochastic_shadows() -> None:
    """Packets with SAH BVHs and single rays with Morton BVHs agree up to rounding."""
    scene, rays = placed_scene(), rays_around(84, 2000)
    packets, alone = (ShadowRig(schedule).light(scene, *rays, method=STOCHASTIC) for schedule in SCHEDULES[:2])
    assert (packets != alone).mean() < 1e-3
    assert 0.2 < packets.mean() < 0.9


@pytest.mark.parametrize("degree", [0, 2, 5])
@pytest.mark.parametrize("response", [{}, {"min_response": 0.2}, {"min_response": 0.3, "adaptive_clamping": False}])
def test_stochastic_shadow_rays_receive_equal_light_in_shrunk_and_full_bvhs(
    rig: ShadowRig, degree: int, response: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hits are equal for any kernel degree and number of instances."""
    config = ls.RenderConfig(response=ls.config.ResponseConfig(**response))
    asset = replace(random_gaussians(85, 150, center=(0, 0, 0), scale_range=(0.01, 0.4)), kernel_degree=degree)
    poses = [similarity((1.0, i, 0.5), 1.1 * i, 0.5 + 0.3 * i, (0.2 * i, -0.1 * i, 4.0)) for i in range(3)]
    scene = ls.Scene([*(ls.SplatInstance(asset, pose) for pose in poses), random_gaussians(86, 100)])
    rays = rays_around(87, 1000)
    found = {}
    for rays_per_gaussian in (0.0, np.inf):
        monkeypatch.setattr(shadow_rays, "SHRINK_RAYS_PER_GAUSSIAN", rays_per_gaussian)
        found[rays_per_gaussian] = [
            rig.light(scene, *rays, config, sample=sample, method=STOCHASTIC, shared_draws=True) for sample in range(8)
        ]
    np.testing.assert_array_equal(found[0.0], found[np.inf])
    assert 0.02 < np.mean(found[0.0]) < 0.98


def test_shrunk_bvhs_are_updated_when_instances_are_added_moved_or_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Instances are added, beyond the limit of instances for shrinking, too, removed and moved; sets are replaced."""
    one, other = (random_gaussians(seed, 100, center=(0.0, 0.0, 0.0)) for seed in (91, 92))
    poses = [similarity((1.0, i, 0.5), 1.1 * i, 0.3, (0.2 * i - 1.0, 0.1 * i, 4.0)) for i in range(12)]
    scenes = [
        ls.Scene([ls.SplatInstance(one, pose) for pose in some])
        for some in (poses[:1], poses[:3], poses, poses[5:7], poses[6:8])
    ]
    scenes += [ls.Scene([*scenes[1].splats, ls.SplatInstance(other, poses[4])]), ls.Scene([other])]
    rays = rays_around(90)
    shadows = {}
    for rays_per_gaussian in (0.0, np.inf):
        monkeypatch.setattr(shadow_rays, "SHRINK_RAYS_PER_GAUSSIAN", rays_per_gaussian)
        rig = ShadowRig()
        shadows[rays_per_gaussian] = [
            rig.light(scene, *rays, sample=sample, method=STOCHASTIC, shared_draws=True)
            for sample, scene in enumerate(scenes)
        ]
    for shrunk, whole in zip(shadows[0.0], shadows[np.inf], strict=True):
        np.testing.assert_array_equal(shrunk, whole)
        assert 0.1 < shrunk.mean() < 0.999


@pytest.mark.parametrize("strength", [0.0, 3.0])
def test_threshold_and_tint_change_stochastic_shadows_as_exact_ones_in_the_mean(
    rig: ShadowRig, strength: float
) -> None:
    """A ray's random numbers are stratified, so each mean of 64 samples is exact to 1/64."""
    scene, rays = ls.Scene([random_gaussians(88, 200)]), rays_around(89, 120)
    options: Any = {"transmittance_threshold": 0.4, "color_strength": strength}
    exact = rig.light(scene, *rays, **options)
    drawn = [rig.light(scene, *rays, sample=sample, method=STOCHASTIC, **options) for sample in range(64)]
    mean = np.mean(drawn, axis=0)
    assert (np.abs(mean - exact) <= 1.0 / 64.0 + 1e-5).all()
    assert abs(float(np.mean(mean - exact))) < 4.0 / 64.0 / math.sqrt(exact.size)
    assert 0.1 < (exact < 0.9).mean() < 0.99


def test_threshold_and_tint_do_not_change_stochastic_shadows_with_shared_draws(rig: ShadowRig) -> None:
    """Such rays are blocked or not, by any of their Gaussians: their transmittance is unknown."""
    scene, rays = ls.Scene([random_gaussians(88, 200)]), rays_around(89)
    options: Any = {"method": STOCHASTIC, "shared_draws": True}
    plain = rig.light(scene, *rays, **options)
    other = rig.light(scene, *rays, **options, transmittance_threshold=0.8, color_strength=3.0)
    np.testing.assert_array_equal(plain, other)


@pytest.mark.parametrize("pipeline", DIRECT)
def test_resumed_frames_draw_new_stochastic_shadows_for_each_sample(pipeline: ls.Pipeline) -> None:
    """Two samples plus two more equal four samples."""
    floor = ls.SplatInstance(
        joined(*(one_gaussian((x, 0.6, z), (0.3, 0.05, 0.3), 0.95) for x in (-0.4, 0.0, 0.4) for z in (3.6, 4.0, 4.4))),
        material=ls.MaterialSimple(diffuse=(1.0, 1.0, 1.0)),
    )
    scene = ls.Scene([floor, one_gaussian((0.0, -0.4, 4.0), 0.25, 0.6)], lights=[ls.LightDirectional((0, 1, 0))])
    camera = ls.Camera.look_at((0.0, -1.0, 0.5), (0.0, 0.3, 4.0), (0, -1, 0), width=24, height=16, fov_y=0.6)
    # Without jitter, samples differ only by their shadows.
    config = ls.RenderConfig(pipeline=pipeline, jitter=False, shadow_rays=ls.ShadowConfig(method=STOCHASTIC))
    renderers = {count: ls.create_renderer(replace(config, samples=count), "cpu") for count in (1, 2, 4)}
    whole = renderers[4].render(scene, camera)
    half = renderers[2].render(scene, camera)
    np.testing.assert_allclose(renderers[2].render(scene, camera, resume=half).color, whole.color, atol=1e-6)
    assert np.abs(half.color - whole.color).max() > 0.01


def test_stochastic_shadows_of_a_capture_converge_to_exact_shadows(data_dir: Path) -> None:
    """The downloaded biker capture casts shadows on itself and its surroundings; 64 samples have a PSNR of 35 dB."""
    scene = ls.Scene([load_gaussians(data_dir / "splats" / "biker.compressed.ply")])
    camera = ls.Camera.look_at((0.9, -2.2, -3.6), (-0.1, -1.6, 0.0), (0, -1, 0), width=96, height=56, fov_y=0.85)
    directions = (camera.ray_directions() @ camera.camera_from_world[:3, :3]).reshape(-1, 3)
    depth = ls.trace_rays(scene, camera.eye, directions, device="cpu").depth
    hits_surface = np.isfinite(depth)
    points = camera.eye + depth[hits_surface, None] * directions[hits_surface]
    to_light = normalized(np.array([0.6, -1.5, -1.0]))
    rig = ShadowRig()
    exact = rig.light(scene, points, to_light, t_min=0.02)[:, 0]
    mean = chances(rig, scene, (points, np.broadcast_to(to_light, points.shape)), 64, t_min=0.02)
    error = float(np.mean((mean - exact) ** 2))
    assert -10.0 * math.log10(error) > 29.0
    assert -10.0 * math.log10(error * hits_surface.mean()) > 35.0
