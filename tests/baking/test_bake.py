"""Baked light compared with analytic results and path-traced frames, and invariants of a bake."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.baking import bake as bake_module
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from support.kinds import for_splats
from support.scenes.path_scenes import ball, diffuse
from support.scenes.raster_scenes import similarity

SKY = ls.LightEnvironment(color=(0.5, 0.4, 0.3), visible=False)
SUN = ls.LightDirectional((0.3, -1.0, 0.2), color=(1.0, 0.9, 0.8), intensity=2.0)
PATH, TRACE = ls.RenderConfig(pipeline=ls.Pipeline.PATH), ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)


def splats_of(mesh: ls.Mesh, count: int) -> ls.SplatInstance:
    """Returns Gaussians of a mesh, with the mesh's material."""
    return ls.SplatInstance(ls.gaussians_from_mesh(mesh, count), material=for_splats(mesh.material))


def baked(scene: ls.Scene, config: ls.RenderConfig = PATH, **options: Any) -> ls.Scene:
    """Bakes a scene on the CPU."""
    return ls.bake(scene, config, device="cpu", **options)


def colors_along_normals(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns the colours of N Gaussians viewed along their normals, shape (N, 3)."""
    assert gaussians.normals is not None
    basis = sh_basis(-gaussians.normals.astype(np.float64), gaussians.sh_degree)
    return np.maximum(np.einsum("nk,nkc->nc", basis, gaussians.sh) + 0.5, 0.0)


def floor(count: int = 200) -> ls.SplatInstance:
    """Returns a level square of Gaussians with albedo 0.6 that faces up."""
    return splats_of(ls.plane(2.0, 2.0, material=diffuse(0.6)), count)


def test_baked_white_body_in_a_white_furnace_has_the_environments_colour() -> None:
    """A white body in a constant environment is as bright as the environment, however often light bounces."""
    scene = ls.Scene([splats_of(ball(1.0, diffuse(1.0), rows=16), 150)], lights=[SKY])
    (shown,) = baked(scene).splats
    expected = encode_srgb(np.array(SKY.color))
    colors = colors_along_normals(shown.gaussians)
    np.testing.assert_allclose(colors.mean(axis=0), expected, atol=0.004)
    assert np.abs(colors - expected).max() < 0.05
    for camera in views_of(scene):
        frame = ls.render(ls.Scene([shown]), camera, replace(TRACE, samples=1), device="cpu")
        inside = frame.alpha > 0.98
        assert inside.sum() > 500
        assert np.abs(frame.color / np.maximum(frame.alpha, 0.5)[..., None] - expected)[inside].max() < 0.03


def test_baked_plane_in_sunlight_follows_lamberts_law() -> None:
    """Radiance is albedo / pi times irradiance times cosine, from all directions above, at any exposure."""
    scene = ls.Scene([floor()], lights=[SUN])
    travel = np.array(SUN.direction) / np.linalg.norm(SUN.direction)
    for exposure in (0.0, 1.0):
        (shown,) = baked(scene, TRACE, exposure=exposure).splats
        light = 2.0**exposure * 0.6 / np.pi * SUN.intensity * np.array(SUN.color) * -travel[1]
        expected = np.minimum(encode_srgb(light), 1.0)
        for away in ((0.0, 1.0, 0.0), (0.6, 0.8, 0.0), (0.0, 0.4, -0.9165)):
            basis = sh_basis(-np.array(away), 3)
            colors = 0.5 + np.einsum("k,nkc->nc", basis, shown.gaussians.sh)
            np.testing.assert_allclose(colors, np.broadcast_to(expected, colors.shape), atol=0.01)


def test_baked_integrating_sphere_matches_path_tracing() -> None:
    """An integrating sphere around a small light is as bright as path tracing shows it from the centre.

    The discs are 2 % darker in display values than a sphere, E = E0 / (1 - albedo (1 - r^2 / R^2)): 3 % of each bounce
    escapes at grazing angles, where neighbours are too near to cast a shadow, and the light has facets.
    """
    radius, albedo, shines = 0.2, 0.5, 20.0
    emitter = ball(radius, diffuse(0.0, shines), rows=16)
    walls = splats_of(ball(1.0, diffuse(albedo), hollow=True), 600)
    scene = ls.Scene([walls], [emitter], lights=[])
    (shown,) = baked(scene, replace(PATH, samples=4), directions=16).splats
    outwards = even_directions(100).astype(np.float32)
    rays = (0.5 * outwards, outwards)
    radiance = ls.trace_rays(ls.Scene([shown]), *rays, TRACE, device="cpu").radiance.mean(axis=0)
    paths = ls.trace_rays(scene, *rays, replace(PATH, samples=256), device="cpu").radiance.mean(axis=0)
    np.testing.assert_allclose(radiance, encode_srgb(paths), rtol=0.005)
    direct = np.pi * shines * radius**2
    light = albedo / np.pi * direct / (1.0 - albedo * (1.0 - radius**2))
    np.testing.assert_allclose(encode_srgb(paths), encode_srgb(np.full(3, light)), rtol=0.03)
    assert colors_along_normals(shown.gaussians).std() < 0.05  # 256 paths per Gaussian


def views_of(scene: ls.Scene, away: float = 3.5) -> list[ls.Camera]:
    """Returns cameras around the origin."""
    eyes = [(0.0, 0.3, -1.0), (0.9, 0.4, 0.2), (-0.5, -0.2, 0.9), (-0.9, 0.6, -0.4)]
    return [
        ls.Camera.look_at(away * np.array(eye), (0, 0, 0), (0, 1, 0), width=48, height=48, fov_y=0.6) for eye in eyes
    ]


def test_baked_sh_do_not_depend_on_the_transform_of_the_instance() -> None:
    """A capture rotated, scaled and moved together with its light gets the same SH in object space."""
    shiny = splats_of(ball(1.0, ls.MaterialPbr(base_color=(0.5, 0.5, 0.5), metallic=1.0, roughness=0.5)), 100)
    light = ls.LightPoint((2.0, 2.0, -2.0), intensity=12.0)
    # A rotation by 120 degrees around a diagonal keeps the scene's box, which limits camera distances.
    position = similarity((1.0, 1.0, 1.0), 2.0 * np.pi / 3.0, scale=0.5, offset=(3.0, -1.0, 2.0))
    moved = replace(light, position=tuple(position[:3, :3] @ light.position + position[:3, 3]), intensity=3.0)
    here = baked(ls.Scene([shiny], lights=[light]), TRACE).splats[0]
    there = baked(ls.Scene([replace(shiny, world_from_object=position)], lights=[moved]), TRACE).splats[0]
    np.testing.assert_array_equal(there.transform, position)
    np.testing.assert_allclose(there.gaussians.sh, here.gaussians.sh, atol=2e-3)
    assert np.abs(here.gaussians.sh[:, 1:]).max() > 0.1


def test_bake_changes_neither_captures_that_are_not_lit_nor_shapes_of_lit_gaussians() -> None:
    """A capture without a material stays the same object; a lit one keeps shapes and normals, but no materials."""
    unlit = ls.SplatInstance(ls.gaussians_from_mesh(ball(0.5, diffuse(0.4)), 50), name="kept")
    lit = replace(floor(60), name="lit")
    result = baked(ls.Scene([unlit, lit], lights=[SUN], up="y-up"), TRACE, directions=8)
    assert result.splats[0] is unlit
    assert result.up == (0.0, 1.0, 0.0) and not result.lights and not result.meshes
    shown = result.splats[1]
    assert shown.name == "lit" and shown.material is None
    for name in ("means", "rotations_wxyz", "scales", "opacities", "normals"):
        assert getattr(shown.gaussians, name) is getattr(lit.gaussians, name)
    assert shown.gaussians.albedo is shown.gaussians.roughness is shown.gaussians.metallic is None


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_baking_darkens_a_shadow_catcher_inside_the_shadow_and_nowhere_else(pipeline: ls.Pipeline) -> None:
    """Colours are darker where a mesh blocks the sun, and the same to the bit elsewhere."""
    capture = replace(floor(1200), material=ls.MaterialSimple(ambient=0.0), shadow_catcher=True)
    roof = ls.MeshInstance(ls.box((0.8, 0.02, 0.8), material=diffuse(0.0)), position=(-0.5, 0.5, 0.0))
    down = ls.LightDirectional((0.0, -1.0, 0.0), intensity=2.0)
    config = ls.RenderConfig(pipeline=pipeline, samples=2, max_bounces=0)
    (shown,) = baked(ls.Scene([capture], [roof], [down]), config, directions=8).splats
    assert not shown.shadow_catcher and shown.material is None
    means, before, after = capture.gaussians.means, capture.gaussians.sh, shown.gaussians.sh
    size = float(np.median(capture.gaussians.scales.max(axis=1)))
    below = (np.abs(means[:, 0] + 0.5) < 0.4 - 3 * size) & (np.abs(means[:, 2]) < 0.4 - 3 * size)
    apart = means[:, 0] > 0.0 + 4 * size
    assert below.sum() > 10 and apart.sum() > 50
    assert (after[below, 0] < before[below, 0] - 0.2).all()
    if pipeline is ls.Pipeline.TRACE:  # a path may hit the roof from anywhere
        np.testing.assert_array_equal(after[apart], before[apart])


def test_shadow_baked_into_a_shadow_catcher_removes_no_more_than_the_suns_irradiance() -> None:
    """A shadow catcher also holds light of lights that the scene lacks, so a dim sun's shadow removes only E / pi.

    Gaussians seen from below, where the sun does not shine, lose less.
    """
    capture = replace(floor(), material=ls.MaterialSimple(ambient=0.0), shadow_catcher=True)
    roof = ls.MeshInstance(ls.box((9.0, 0.02, 9.0), material=diffuse(0.0)), position=(0.0, 0.5, 0.0))
    dim = ls.LightDirectional((0.0, -1.0, 0.0), intensity=0.5)
    (shown,) = baked(ls.Scene([capture], [roof], [dim]), replace(PATH, samples=2, max_bounces=0), directions=8).splats
    before, after = (decode_srgb(0.5 + SH_C0 * one.gaussians.sh[:, 0]) for one in (capture, shown))
    taken = (before - after) * np.pi / 0.5
    np.testing.assert_allclose(taken.max(), 1.0, atol=1e-3)
    assert np.median(taken) > 0.8


def test_bakes_with_equal_seeds_are_equal_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result does not depend on the number of views on the device at once; another seed gives another result."""
    scene = ls.Scene([splats_of(ball(1.0, diffuse(0.5), rows=16), 60)], lights=[SKY, SUN])
    config = replace(PATH, samples=2)

    def found(config: ls.RenderConfig) -> np.ndarray:
        return baked(scene, config, directions=8).splats[0].gaussians.sh

    first = found(config)
    monkeypatch.setattr(bake_module, "VIEWS_AT_ONCE", 8 * 7)
    np.testing.assert_array_equal(found(config), first)
    assert not np.array_equal(found(replace(config, seed=1)), first)


def test_baked_gaussians_inside_a_closed_body_have_finite_colours() -> None:
    """Gaussians inside have hardly any light, no NaN, and no value out of range."""
    hidden = replace(splats_of(ball(0.4, diffuse(0.5)), 40))
    scene = ls.Scene([splats_of(ball(1.0, diffuse(0.5), rows=16), 150), hidden], lights=[SKY])
    for instance in baked(scene, replace(PATH, samples=2), directions=8).splats:
        assert np.isfinite(instance.gaussians.sh).all()
        assert np.abs(instance.gaussians.sh).max() < 4.0


def test_reported_progress_of_a_bake_starts_at_0_and_never_decreases() -> None:
    """Fractions never decrease."""
    reports: list[float] = []

    def report(label: str, fraction: float) -> None:
        if label == "baking":
            reports.append(fraction)

    baked(ls.Scene([floor(60), floor(60)], lights=[SUN]), TRACE, directions=8, progress=report)
    assert reports == sorted(reports) and reports[0] == 0.0 and reports[-1] >= 0.5


@pytest.mark.parametrize(
    ("scene", "options", "error", "message"),
    [
        (ls.Scene(), {}, ls.SceneError, "takes a scene with splat sets"),
        (ls.Scene([floor(20)]), {}, ls.SceneError, "no lights"),
        (ls.Scene([replace(floor(20), material=None)], lights=[SUN]), {}, ls.SceneError, "no splat set has a material"),
        (ls.Scene([floor(20)], lights=[SUN]), {"degree": 4}, ls.ConfigError, "degree is 4"),
        (ls.Scene([floor(20)], lights=[SUN]), {"directions": 3}, ls.ConfigError, "directions is 3"),
        (ls.Scene([floor(20)], lights=[SUN]), {"exposure": float("nan")}, ls.ConfigError, "exposure is nan"),
        (ls.Scene([floor(20)], lights=[SUN]), {"config": replace(PATH, samples=1)}, ls.ConfigError, "samples is 1"),
        (ls.Scene([floor(20)], lights=[SUN]), {"config": ls.RenderConfig()}, ls.ConfigError, "Pipeline.PATH"),
        (floor(20), {}, ls.SceneError, "expected a Scene"),
    ],
)
def test_bake_refuses_each_invalid_argument_with_an_error_that_names_it(
    scene: Any, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    """Messages are one line, and come before any slow work."""
    with pytest.raises(error, match=message) as raised:
        ls.bake(scene, device="cpu", **options)
    assert "\n" not in str(raised.value)
