"""Irradiance by scattered rays does not depend on the distance of the eye."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import diffuse, quad

ROUGH = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.6)


def blob(kind: str) -> ls.SplatInstance:
    """Returns a round Gaussian, emissive or lit, that faces the eye because it has no normal."""
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 1] = 0.9 * (kind == "kept")
    gaussians = ls.Gaussians(
        means=np.array([[0.0, 0.5, 0.0]]),
        rotations_wxyz=np.array([[1.0, 0.0, 0.0, 0.0]]),
        scales=np.full((1, 3), 0.35),
        opacities=np.array([0.99]),
        sh=sh,
        albedo=None if kind == "kept" else np.full((1, 3), 0.9),
    )
    return ls.SplatInstance(gaussians, material=None if kind == "kept" else diffuse(1.0))


@pytest.mark.parametrize(
    ("pipeline", "kind"),
    [(ls.Pipeline.PATH, "kept"), (ls.Pipeline.PATH, "relit"), (ls.Pipeline.TRACE, "kept")],
    ids=["path-kept", "path-relit", "trace-kept"],
)
def test_path_traced_brightness_does_not_depend_on_viewing_distance(pipeline: ls.Pipeline, kind: str) -> None:
    """One point is seen in one direction from two distances, on a diffuse floor and in a highlight."""
    material = diffuse(0.5) if pipeline is ls.Pipeline.PATH else ROUGH
    floor = quad((-3, 0, -3), (0, 0, 6), (6, 0, 0), material)
    scene = ls.Scene(splats=[blob(kind)], meshes=[floor], lights=[ls.LightDirectional((-1, 0.05, 0.3), intensity=3.0)])
    if kind == "kept":
        scene = replace(scene, lights=[ls.LightPoint((0.0, -5.0, 0.0))])
    point, towards, count = np.array([1.2, 0.0, 0.0]), np.array([0.6, 0.8, 0.0]), 400
    config = ls.RenderConfig(pipeline=pipeline, samples=16, max_bounces=1, lighting=True, glossy_reflections=True)
    means = []
    for distance in (0.5, 100.0):
        origins, directions = np.tile(point + distance * towards, (count, 1)), np.tile(-towards, (count, 1))
        means.append(ls.trace_rays(scene, origins, directions, config, device="cpu").radiance.mean())
    assert means[0] > 1e-4
    np.testing.assert_allclose(means[1], means[0], rtol=5e-3)
