"""Thin haze in lit frames: haze of emissive sets is shown as captured, haze of relit sets is lit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb
from support.compare.backends import BACKENDS, renderer_of
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import flat_sh, front_camera

PIPELINES = pytest.mark.parametrize("pipeline", DIRECT, ids=lambda pipeline: pipeline.value)
FACING = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
GREEN, RED = np.array([0.2, 0.7, 0.3]), np.array([0.8, 0.3, 0.2])
GLOWING = ls.MaterialSimple(emissive=(0.5, 0.5, 0.5))
"""Relit material that emits half of its albedo without light and shows no captured radiance."""
KEPT = {
    "shadow-only": {"shadow_catcher": True},
    "ambient": {"material": ls.MaterialSimple(ambient=(0.4, 0.4, 0.4))},
    "diffuse": {"material": ls.MaterialSimple(diffuse=(0.5, 0.5, 0.5))},
}


def veil(depth: float, opacity: float, color: np.ndarray) -> ls.Gaussians:
    """Returns one flat Gaussian, so wide that its alpha is constant over the view."""
    return ls.Gaussians(
        [[0.0, 0.0, depth]], [[1.0, 0.0, 0.0, 0.0]], [[40.0, 40.0, 0.002]], [opacity], flat_sh(color[None])
    )


def frame_of(splats: list[ls.SplatInstance], pipeline: ls.Pipeline = ls.Pipeline.TRACE, **settings: object) -> ls.Frame:
    """Renders a frame from the front under a light along the view."""
    config = replace(ls.RenderConfig(pipeline=pipeline, lighting=True), **settings)
    return ls.render(ls.Scene(splats=splats, lights=[FACING]), front_camera(24, 18, 30.0), config, device="cpu")


@PIPELINES
@pytest.mark.parametrize("kind", KEPT)
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.9, 0.6, 0.1), None], ids=["black", "orange", "none"])
def test_captured_haze_too_thin_for_a_surface_is_equal_in_lit_and_unlit_frames(
    background: tuple[float, float, float] | None, kind: str, pipeline: ls.Pipeline
) -> None:
    """The bits are equal where alpha is too low for an iso-opacity surface."""
    splats = [ls.SplatInstance(veil(2.0, 0.2, GREEN), **KEPT[kind])]
    lit = frame_of(splats, pipeline, background=background)
    unlit = frame_of(splats, pipeline, background=background, lighting=False)
    assert lit.alpha.max() == pytest.approx(0.2, abs=1e-3)
    np.testing.assert_array_equal(lit.alpha, unlit.alpha)
    np.testing.assert_array_equal(lit.pixels_srgb(), unlit.pixels_srgb())


@PIPELINES
@pytest.mark.parametrize("first", ["captured", "relit"])
@pytest.mark.parametrize("opacity", [0.12, 0.5, 0.9])
def test_light_of_overlapping_emissive_and_relit_haze_is_the_sum_of_both(
    opacity: float, first: str, pipeline: ls.Pipeline
) -> None:
    """The sum holds whichever set is in front, and whether or not there is an iso-opacity surface."""
    depths = (2.0, 2.5) if first == "captured" else (2.5, 2.0)
    captured = ls.SplatInstance(veil(depths[0], opacity, GREEN))
    relit = ls.SplatInstance(veil(depths[1], opacity, RED), material=GLOWING)
    shares = (opacity, opacity * (1.0 - opacity))
    share_captured, share_relit = shares if first == "captured" else shares[::-1]
    expected = share_captured * decode_srgb(GREEN) + 0.5 * share_relit * decode_srgb(RED)
    for splats in ([captured, relit], [relit, captured]):
        frame = frame_of(splats, pipeline, background=None)
        middle = frame.color[7:11, 10:14].mean(axis=(0, 1))
        np.testing.assert_allclose(middle, expected, rtol=3e-3)


@pytest.mark.parametrize("strategy", [ls.config.TraceStrategy.STOCHASTIC_HIT, ls.config.TraceStrategy.STOCHASTIC_PASS])
def test_mean_of_stochastic_hits_on_emissive_and_relit_layers_equals_the_sorted_blend(
    strategy: ls.config.TraceStrategy,
) -> None:
    """Three layers of emissive and relit sets have the sorted mean, for both stochastic strategies."""
    splats = [
        ls.SplatInstance(veil(2.0, 0.3, GREEN)),
        ls.SplatInstance(veil(2.2, 0.4, RED), material=GLOWING),
        ls.SplatInstance(veil(2.4, 0.3, GREEN)),
    ]
    exact = frame_of(splats, background=None, jitter=False)
    trace = ls.TraceConfig(strategy=strategy, hits_per_pass=4)
    mean = frame_of(splats, background=None, jitter=False, trace=trace, samples=64)
    np.testing.assert_allclose(mean.color.mean(axis=(0, 1)), exact.color.mean(axis=(0, 1)), rtol=0.02)


@PIPELINES
@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside a captured set"])
def test_relit_haze_too_thin_for_a_surface_reflects_light_in_proportion_to_its_alpha(
    beside: bool, pipeline: ls.Pipeline
) -> None:
    """Brightness does not jump where alpha reaches 0.3, from which on an iso-opacity surface exists."""
    material = ls.MaterialSimple(emissive=(0.0, 0.0, 0.0), diffuse=(1.0, 1.0, 1.0))
    more = [ls.SplatInstance(veil(9.0, 1e-6, GREEN))] if beside else []
    for opacity in (0.05, 0.29, 0.31):
        splats = [ls.SplatInstance(veil(2.0, opacity, RED), material=material), *more]
        frame = frame_of(splats, pipeline, background=None, shadows=ls.Shadows.OFF)
        middle = frame.color[7:11, 10:14].mean(axis=(0, 1))
        np.testing.assert_allclose(middle, opacity * decode_srgb(RED), rtol=0.01)


@PIPELINES
def test_pixels_that_no_relit_gaussian_covers_are_equal_in_lit_and_unlit_frames(pipeline: ls.Pipeline) -> None:
    """Pixels that no relit Gaussian covers have equal bits in the lit and the unlit frame."""
    capture = ls.SplatInstance(veil(2.0, 0.6, GREEN))
    spot = ls.Gaussians([[-0.4, 0.0, 1.9]], [[1.0, 0.0, 0.0, 0.0]], [[0.05, 0.05, 0.05]], [0.8], flat_sh(RED[None]))
    lit = frame_of([capture, ls.SplatInstance(spot, material=GLOWING)], pipeline)
    unlit = frame_of([capture], pipeline, lighting=False)
    same = (lit.pixels_srgb() == unlit.pixels_srgb()).all(axis=-1)
    assert 0.7 < same.mean() < 0.99
    assert same[:, 12:].all()


@pytest.mark.parametrize("backend", BACKENDS)
@PIPELINES
def test_cpu_and_cuda_schedules_blend_emissive_and_relit_layers_to_equal_frames(
    pipeline: ls.Pipeline, backend: str
) -> None:
    """Between the layers is a mesh; all frames agree up to rounding."""
    splats = [ls.SplatInstance(veil(2.0 + 0.1 * k, 0.2, GREEN)) for k in range(3)]
    splats += [ls.SplatInstance(veil(2.05 + 0.1 * k, 0.2, RED), material=GLOWING) for k in range(3)]
    corners = [[-0.2, -0.2, 2.12], [0.3, -0.2, 2.12], [0.0, 0.3, 2.12]]
    scene = ls.Scene(splats=splats, meshes=[ls.Mesh(corners, [[0, 2, 1]])], lights=[FACING])
    config = ls.RenderConfig(pipeline=pipeline, lighting=True)
    camera = front_camera(24, 18, 30.0)
    frame = renderer_of(backend, config).render(scene, camera)
    np.testing.assert_allclose(frame.color, renderer_of("cpu", config).render(scene, camera).color, atol=2e-6)
