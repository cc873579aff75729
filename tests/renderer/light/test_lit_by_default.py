"""Scenes that are lit by default."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import front_camera, octahedron, one_gaussian

LIGHT = ls.LightPoint((0.0, 0.0, 0.0))


@pytest.mark.parametrize("pipeline", DIRECT)
def test_scene_of_meshes_without_lights_is_lit_by_a_headlight(pipeline: ls.Pipeline) -> None:
    """Faces of a mesh differ in brightness, as with lighting=True; unlit faces would have one flat colour."""
    scene = ls.Scene(meshes=[octahedron((0.0, 0.0, 4.0), 1.0)])
    frame, asked, flat = (
        ls.render(scene, front_camera(40, 30), ls.RenderConfig(pipeline=pipeline, lighting=lighting), device="cpu")
        for lighting in (None, True, False)
    )
    np.testing.assert_array_equal(frame.pixels_srgb(), asked.pixels_srgb())
    inside = frame.alpha == 1.0
    assert np.ptp(frame.pixels_srgb()[inside], axis=0).max() > 0.05
    assert np.ptp(flat.pixels_srgb()[inside], axis=0).max() < 1e-6


@pytest.mark.parametrize(
    ("scene", "is_lit"),
    [
        (ls.Scene(), False),
        (ls.Scene([one_gaussian()]), False),
        (ls.Scene([one_gaussian()], [octahedron((0.0, 0.0, 4.0), 0.5)]), True),
        (ls.Scene([], [octahedron((0.0, 0.0, 4.0), 0.5)]), True),
        (ls.Scene([one_gaussian()], lights=[LIGHT]), True),
    ],
)
def test_captures_without_lights_are_rendered_unlit(scene: ls.Scene, is_lit: bool) -> None:
    """Captures are lit only if there are lights; meshes are always lit."""
    assert scene.is_lit_by_default is is_lit
    assert (ls.render(scene, front_camera(8, 6), device="cpu").light is not None) is is_lit


def test_queried_rays_without_a_camera_are_not_lit_by_a_headlight() -> None:
    """A headlight needs a camera position."""
    scene = ls.Scene(meshes=[octahedron((0.0, 0.0, 4.0), 1.0)])
    unlit = ls.RenderConfig(lighting=False)
    rays = ((0.0, 0.0, 0.0), [(0.0, 0.1, 1.0), (0.1, 0.0, 1.0)])
    found, expected = (ls.trace_rays(scene, *rays, config, device="cpu") for config in (None, unlit))
    np.testing.assert_array_equal(found.radiance, expected.radiance)
