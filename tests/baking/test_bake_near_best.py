"""Baked SH compared with the best possible SH for the same Gaussians, as bench/baked.py measures."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bench import baked as bench

import lumisplat as ls
from lumisplat.baking import joint_sh_fit
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions
from support.kinds import for_splats
from support.scenes.path_scenes import ball

FITTED_VIEWS, PATHS = 40, 16
"""Number of views that the best SH are fitted to, and their paths per pixel."""

TRACE = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
"""Settings of direct light, which has no noise with point lights."""


def glossy_ball(count: int = 300) -> ls.Scene:
    """Returns a glossy ball between a red and a blue light."""
    lights = [
        ls.LightPoint((2.0, 2.0, -2.0), color=(1.0, 0.5, 0.4), intensity=12.0),
        ls.LightPoint((-2.0, 1.0, 2.0), color=(0.3, 0.5, 1.0), intensity=12.0),
    ]
    metal = ls.MaterialPbr(base_color=(0.5, 0.5, 0.5), metallic=0.7, roughness=0.5)
    return ls.Scene(
        [ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, metal), count), material=for_splats(metal))], lights=lights
    )


def view_from(side: Any, pixels: int) -> ls.Camera:
    """Returns a camera that looks at the ball."""
    return ls.Camera.look_at(3.5 * np.array(side), (0, 0, 0), (0, 1, 0), width=pixels, height=pixels, fov_y=0.6)


def views_around(scene: ls.Scene, count: int = 120) -> list[bench.View]:
    """Renders frames in direct light, with the pixels that Gaussians cover."""
    renderer = ls.create_renderer(TRACE, "cpu")

    def light(rays: bench.Rays, _half: int) -> np.ndarray:
        return renderer.trace_rays(scene, *rays).radiance.astype(np.float64)

    learnt: list[bench.View] = []
    for side in even_directions(count):
        view = bench.lit_view(scene, view_from(side, 20), light, "cpu")
        whole = np.asarray(view.blend.sum(axis=1)).ravel() > 0.98
        truth = view.truth[0][whole], view.truth[1][whole]
        learnt.append(replace(view, truth=truth, blend=view.blend[np.flatnonzero(whole)]))
    return learnt


def decibels(shown: ls.Scene, scene: ls.Scene) -> float:
    """Returns the PSNR of unlit frames of a capture against lit frames, in display values of opaque pixels."""
    errors: list[np.ndarray] = []
    for side in ((0.0, 0.3, -1.0), (0.9, 0.4, 0.2), (-0.5, -0.2, 0.9), (-0.9, 0.6, -0.4)):
        camera = view_from(side, 48)
        unlit = ls.render(shown, camera, replace(TRACE, samples=1), device="cpu")
        lit = ls.render(scene, camera, TRACE, device="cpu")
        inside = unlit.alpha > 0.98
        errors.append((unlit.color - np.clip(encode_srgb(lit.color), 0.0, 1.0))[inside])
    return float(-10.0 * np.log10(np.square(np.concatenate(errors)).mean()))


def test_highlight_baked_to_sh_of_degree_3_has_a_higher_psnr_than_to_degree_0() -> None:
    """The error of degree 3 is 3 dB lower."""
    scene = glossy_ball(150)
    even, following = (decibels(ls.bake(scene, TRACE, degree=degree, device="cpu"), scene) for degree in (0, 3))
    print(f"degree 0: {even:.2f} dB, degree 3: {following:.2f} dB")
    assert following > even + 3.0


@pytest.mark.deep
def test_baked_highlight_has_at_most_1_db_less_psnr_than_optimal_sh_coefficients() -> None:
    """The best SH are fitted to 120 other views without noise; at degree 3 they are 0.6 dB below a fit to 400 views."""
    scene = glossy_ball()
    learnt = views_around(scene)
    found: dict[int, float] = {}
    for degree in (0, 3):
        best = bench.best_sh(learnt, np.zeros((scene.gaussian_count, (degree + 1) ** 2, 3)), 0.03)
        gaussians = replace(scene.splats[0].gaussians, sh=best.astype(np.float32))
        found[degree] = decibels(ls.Scene([ls.SplatInstance(gaussians)]), scene)
        baked = decibels(ls.bake(scene, TRACE, degree=degree, device="cpu"), scene)
        print(f"degree {degree}: baked {baked:.2f} dB, best {found[degree]:.2f} dB")
        assert baked > found[degree] - 1.0
    assert found[3] > found[0] + 4.0


@pytest.mark.deep
def test_baking_in_parts_of_100_gaussians_lowers_psnr_by_less_than_1_db(monkeypatch: pytest.MonkeyPatch) -> None:
    """A large capture is fitted in parts: of 300 Gaussians, 100 at a time, most are at a border.

    The loss is 0.3 to 1.0 dB with five seeds, 0.8 in the mean of two, and twice as much if later rays override earlier
    ones.
    """
    scene = glossy_ball()

    def baked() -> float:
        seeds = (ls.bake(scene, replace(TRACE, seed=seed), device="cpu") for seed in (0, 1))
        return float(np.mean([decibels(one, scene) for one in seeds]))

    whole = baked()
    monkeypatch.setattr(joint_sh_fit, "JOINT_RAYS", 100 * 64)
    parts = baked()
    fit = joint_sh_fit.refitted_sh
    monkeypatch.setattr(
        joint_sh_fit,
        "refitted_sh",
        lambda blend, some, sh, information: fit(blend, some, sh, np.zeros_like(information)),
    )
    overriding = baked()
    print(f"whole {whole:.2f} dB, in parts {parts:.2f} dB, if later rays override earlier ones {overriding:.2f} dB")
    assert parts > whole - 1.0
    assert whole - parts < 0.7 * (whole - overriding)


@pytest.mark.deep
def test_baked_room_has_at_most_1_db_less_psnr_than_optimal_sh_coefficients() -> None:
    """The room has 1,300 Gaussians and 16 views; the best SH are fitted from the bake and 40 other views.

    The target is 1 dB: 29.7 dB against 30.6. Larger scenes miss the target (docs/benchmarks.md#bake).
    """
    case = bench.cases(100)["room"]()
    rng = np.random.default_rng(0)
    learnt, views = (
        [bench.view_of(case.scene, case.camera(rng), 10**5 + 2 * k, paths, "cpu") for k in range(count)]
        for count, paths in ((FITTED_VIEWS, PATHS // 2), (bench.VIEWS, 24))
    )
    options: Any = SimpleNamespace(samples=8, directions=32, device="cpu")
    alone, sh = bench.baked_sh(case.scene, 3, options)
    best = max(bench.decibels(views, bench.best_sh(learnt, sh, ridge)) for ridge in (0.3, 1.0, 3.0))
    shown = bench.decibels(views, sh)
    print(f"alone {bench.decibels(views, alone)}, baked {shown}, best {best}")
    assert shown > bench.decibels(views, alone) + 2.0
    assert shown > best - 1.0
