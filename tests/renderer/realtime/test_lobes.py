"""Highlight rays in real time: reflections in rough surfaces, against the path tracer."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import quad

VIEW = ls.Camera.look_at((0.0, 0.6, -2.0), (0.0, 0.0, 0.3), width=96, height=64, fov_y=0.5)
LIGHT = ls.LightDirectional((0.0, 0.0, 1.0), intensity=3.0)


def corner(roughness: float) -> ls.Scene:
    """Returns a metal floor before a wall of two colours; the light reaches the wall only."""
    floor = ls.MaterialPbr(base_color=(0.1, 0.1, 0.1), metallic=1.0, roughness=roughness)
    red, blue = (ls.MaterialPbr(base_color=c, specular=0.0, roughness=1.0) for c in ((0.8, 0.1, 0.1), (0.1, 0.1, 0.8)))
    return ls.Scene(
        meshes=[
            quad((-3, 0, -3), (0, 0, 4), (6, 0, 0), floor),
            quad((-3, 0, 1), (0, 3, 0), (3, 0, 0), red),
            quad((0, 0, 1), (0, 3, 0), (3, 0, 0), blue),
        ],
        lights=[LIGHT],
    )


def test_rough_reflections_from_screen_probes_are_blurrier_than_by_highlight_rays() -> None:
    """With probes alone, blue shows on the red side, and the total light stays within 20 %."""
    scene = corner(0.2)
    sharp = halves(glossy(scene, ls.Pipeline.REALTIME, 8))
    blurred = halves(glossy(scene, ls.Pipeline.REALTIME, 8, realtime=ls.RealtimeConfig(highlight_rays=False)))
    assert blurred[0, 0, 0] > 1.3 * sharp[0, 0, 0]
    np.testing.assert_allclose(blurred.mean(), sharp.mean(), rtol=0.2)


def glossy(
    scene: ls.Scene, pipeline: ls.Pipeline, frames: int = 1, samples: int | None = None, **changes: Any
) -> np.ndarray:
    """Returns the glossy indirect light, averaged over the later half of the frames."""
    first: Any = {"path": ls.PathConfig(primary="iso")} if pipeline is ls.Pipeline.PATH else {}  # pyright: ignore[reportArgumentType]
    config = ls.RenderConfig(pipeline=pipeline, samples=samples, aovs=("indirect_glossy",), **first, **changes)
    renderer = ls.create_renderer(config, "cpu")
    shown = [renderer.render(scene, VIEW) for _ in range(frames)]
    return np.mean([np.asarray(frame.indirect_glossy) for frame in shown[frames // 2 :]], axis=0)


def halves(image: np.ndarray) -> np.ndarray:
    """Returns means of the floor's left and right half, near the wall and far from it."""
    floor = image[28:60]
    return floor.reshape(2, 16, 2, 48, 3).mean(axis=(1, 3))


@pytest.mark.parametrize("roughness", [0.2, pytest.param(0.45, marks=pytest.mark.deep), 0.6])
def test_realtime_highlights_match_the_path_tracer_at_each_roughness(roughness: float) -> None:
    """By roughness, highlights use rays, rays and probes, or probes: all within 10 %. Only rays keep the colours."""
    scene = corner(roughness)
    truth = halves(glossy(scene, ls.Pipeline.PATH, samples=64))
    found = halves(glossy(scene, ls.Pipeline.REALTIME, 16))
    assert truth[0, 1, 0] > 3.0 * truth[0, 0, 0], "red is right"
    np.testing.assert_allclose(found.mean(axis=-1), truth.mean(axis=-1), rtol=0.1)
    if roughness < 0.4:
        np.testing.assert_allclose(found, truth, rtol=0.1, atol=0.02 * truth.max())
