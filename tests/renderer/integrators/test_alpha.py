"""Surfaces with alpha in camera rays, mirrors and shadows, in all pipelines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import encode_srgb
from support.scenes.pipelines import SAMPLED

PIPELINES = pytest.mark.parametrize("pipeline", list(ls.Pipeline))
VIEW = ls.Camera.look_at((0, 0, -2), (0, 0, 0), (0, -1, 0), width=32, height=16, fov_y=0.4)
GREEN, RED = (0.1, 0.8, 0.1), (0.7, 0.1, 0.1)
HALVES = np.zeros((1, 16, 4), np.uint8)
HALVES[..., :3], HALVES[:, 8:, 3] = 255, 255
"""Texture with alpha 0 in its left half and 1 in its right half."""


def board(z: float, material: ls.MaterialSimple | ls.MaterialPbr, size: float = 2.0) -> ls.Mesh:
    """Returns an upright square around the view axis, with u to the right."""
    corners = size * np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]) + [0, 0, z]
    uvs = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    return ls.Mesh(corners, [[0, 2, 1], [0, 3, 2]], uvs=uvs, material=material)


def emitting(color: tuple[float, float, float], **alpha: Any) -> ls.MaterialSimple:
    """Returns a material that shows its colour without light."""
    return ls.MaterialSimple(base_color=color, wrap_u=ls.TextureWrap.CLAMP, **alpha)


def render(scene: ls.Scene, pipeline: ls.Pipeline, samples: int | None = None, **changes: Any) -> ls.Frame:
    """Renders a frame on the CPU."""
    settings = ls.RenderConfig(pipeline=pipeline, samples=samples, **changes)
    return ls.render(scene, VIEW, settings, device="cpu")


@PIPELINES
@pytest.mark.parametrize("lighting", [True, False])
def test_surface_below_its_alpha_mask_cutoff_is_invisible(pipeline: ls.Pipeline, lighting: bool) -> None:
    """Where alpha is below the cutoff, the camera sees exactly the surface behind."""
    masked = emitting(GREEN, base_color_texture=HALVES, alpha_mode="mask")
    scene = ls.Scene(meshes=[board(0.0, masked), board(1.0, emitting(RED), 4.0)])
    frame = render(scene, pipeline, 1, lighting=lighting, jitter=False)
    left, right = (RED, GREEN) if lighting else (encode_srgb(np.array(RED)), encode_srgb(np.array(GREEN)))
    np.testing.assert_allclose(frame.color[:, :15], np.broadcast_to(left, (16, 15, 3)), atol=2e-6)
    np.testing.assert_allclose(frame.color[:, 17:], np.broadcast_to(right, (16, 15, 3)), atol=2e-6)


def test_masked_surface_whose_alpha_equals_its_cutoff_is_opaque() -> None:
    """Alpha is texture times factor; with a cutoff above 1, no part of the surface is opaque."""
    for alpha, cutoff, is_there in ((0.6, 0.5, True), (0.5, 0.5, True), (0.4, 0.5, False), (1.0, 1.5, False)):
        masked = emitting(GREEN, alpha_mode="mask", alpha=alpha, alpha_cutoff=cutoff)
        scene = ls.Scene(meshes=[board(0.0, masked), board(1.0, emitting(RED), 4.0)])
        color = render(scene, ls.Pipeline.TRACE, 1, lighting=True).color
        np.testing.assert_allclose(color[8, 16], GREEN if is_there else RED, atol=2e-6)


@PIPELINES
def test_alpha_blended_surfaces_weight_their_colours_front_to_back(pipeline: ls.Pipeline) -> None:
    """The first surface has weight 0.25 and the next 0.5 of the rest: exact with continued rays, else in the mean."""
    thin, thick = (emitting(c, alpha_mode="blend", alpha=a) for c, a in ((GREEN, 0.25), (RED, 0.5)))
    last = emitting((0.0, 0.0, 1.0))
    scene = ls.Scene(meshes=[board(0.0, thin), board(0.5, thick, 3.0), board(1.0, last, 4.0)])
    truth = 0.25 * np.array(GREEN) + 0.375 * np.array(RED) + 0.375 * np.array([0.0, 0.0, 1.0])
    exact = pipeline in (ls.Pipeline.TRACE, ls.Pipeline.HYBRID)
    if pipeline is ls.Pipeline.REALTIME:
        renderer = ls.create_renderer(ls.RenderConfig(pipeline=pipeline, lighting=True), "cpu")
        color = np.mean([renderer.render(scene, VIEW).color for _ in range(64)], axis=0)
    else:
        color = render(scene, pipeline, 1 if exact else 64, lighting=True).color
    if exact:
        np.testing.assert_allclose(color, np.broadcast_to(truth, color.shape), atol=2e-6)
    else:
        assert color.std(axis=(0, 1)).max() > 0.01
        np.testing.assert_allclose(color.mean(axis=(0, 1)), truth, atol=0.01)


def test_alpha_blending_of_unlit_surfaces_mixes_display_encoded_colours() -> None:
    """As for captures, encoded colours are blended: exactly in traced frames, by samples in rasterised ones."""
    scene = ls.Scene(
        meshes=[board(0.0, emitting(GREEN, alpha_mode="blend", alpha=0.3)), board(1.0, emitting(RED), 4.0)]
    )
    truth = 0.3 * encode_srgb(np.array(GREEN)) + 0.7 * encode_srgb(np.array(RED))
    traced = render(scene, ls.Pipeline.TRACE, lighting=False)
    np.testing.assert_allclose(traced.color, np.broadcast_to(truth, traced.color.shape), atol=2e-6)
    drawn = render(scene, ls.Pipeline.RASTER, lighting=False)
    assert drawn.samples == 16
    np.testing.assert_allclose(drawn.color.mean(axis=(0, 1)), truth, atol=0.01)


@pytest.mark.parametrize("pipeline", SAMPLED)
@pytest.mark.parametrize(("alpha", "mode"), [(0.25, ls.AlphaMode.BLEND), (1.0, ls.AlphaMode.MASK)])
def test_alpha_of_a_surface_is_the_fraction_of_light_that_it_blocks(
    pipeline: ls.Pipeline, alpha: float, mode: ls.AlphaMode
) -> None:
    """Light is reduced behind the right half of a screen, which has alpha, and not behind its left half."""
    shade = replace(
        emitting((1.0, 1.0, 1.0), base_color_texture=HALVES, alpha_mode=mode, alpha=alpha), emissive=(0.0,) * 3
    )
    wall = board(0.0, ls.MaterialPbr(base_color=(0.5,) * 3, roughness=1.0, specular=0.0))
    light = ls.LightDirectional((0.0, 0.0, 1.0), intensity=2.0)
    screen = board(-3.0, shade, 4.0)
    lit, shaded = (
        render(ls.Scene(meshes=meshes, lights=[light]), pipeline, 1, jitter=False, max_bounces=0).color
        for meshes in ([wall], [wall, screen])
    )
    np.testing.assert_allclose(shaded[:, :14], lit[:, :14], rtol=1e-5)
    np.testing.assert_allclose(shaded[:, 18:], (1.0 - alpha) * lit[:, 18:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID, ls.Pipeline.PATH])
def test_mirrors_reflect_alpha_masked_and_alpha_blended_surfaces(pipeline: ls.Pipeline) -> None:
    """The mirror is in front of the camera, the masked and the blended surface behind it."""
    mirror = board(0.0, ls.MaterialPbr(base_color=(1,) * 3, metallic=1.0, roughness=0.0), 4.0)
    masked = board(-3.0, emitting(GREEN, base_color_texture=HALVES, alpha_mode="mask"), 4.0)
    blended = board(-4.0, emitting(RED, alpha_mode="blend", alpha=0.5), 9.0)
    far = board(-5.0, emitting((0.0, 0.0, 1.0)), 9.0)
    frame = render(ls.Scene(meshes=[mirror, masked, blended, far]), pipeline, 32, lighting=True, jitter=False)
    behind = 0.5 * np.array(RED) + 0.5 * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(frame.color[:, :15].mean(axis=(0, 1)), behind, atol=0.02)
    np.testing.assert_allclose(frame.color[:, 17:].mean(axis=(0, 1)), GREEN, atol=1e-5)


def test_emitter_with_alpha_lights_a_floor_like_an_opaque_one_dimmed_by_the_alpha() -> None:
    """The light on a floor is the same for an emitting square with alpha and for an opaque, darker one."""
    floor = board(0.0, ls.MaterialPbr(base_color=(0.5,) * 3, roughness=1.0, specular=0.0))
    settings: dict[str, Any] = {"max_bounces": 1, "background": None}
    means = []
    for emission in (0.6, 2.0):
        emitter = ls.MaterialPbr(base_color=(0.0,) * 3, specular=0.0, emissive=(emission,) * 3)
        if emission > 1.0:
            emitter = replace(emitter, alpha=0.3, alpha_mode=ls.AlphaMode.BLEND)
        scene = ls.Scene(meshes=[floor, board(-3.0, emitter)])
        means.append(render(scene, ls.Pipeline.PATH, 64, **settings).color.mean())
    np.testing.assert_allclose(means[1], means[0], rtol=0.02)
