"""Layered materials in frames: pipelines agree under a light, and paths show reflections in a coat."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import ball, quad
from support.scenes.pipelines import SAMPLED

VIEW = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=32, height=24, fov_y=0.35)
LIGHT = ls.LightPoint((1.0, -1.5, -2.0), intensity=10.0)
PLAIN: dict[str, Any] = {"base_color": (0.5, 0.1, 0.1), "roughness": 0.8}
LOOKS: dict[str, dict[str, Any]] = {
    "coat": {"clearcoat": 1.0, "clearcoat_roughness": 0.4},
    "sheen": {"sheen_color": (0.2, 0.9, 0.9), "sheen_roughness": 0.5},
    "metal": {"metallic": 1.0},
}


def frame(scene: ls.Scene, pipeline: ls.Pipeline, samples: int = 1, **changes: Any) -> np.ndarray:
    """Returns the colour image of a frame."""
    settings = ls.RenderConfig(pipeline=pipeline, samples=samples, jitter=False, **changes)
    return ls.render(scene, VIEW, settings, device="cpu").color


@pytest.mark.parametrize("look", LOOKS)
def test_all_pipelines_render_equal_clearcoat_sheen_and_rough_metal_under_a_light(look: str) -> None:
    """The scene is a ball without bounces; the layer, or multiple scattering, changes the image visibly."""
    compensated = look == "metal"
    scene = ls.Scene(meshes=[ball(0.3, ls.MaterialPbr(**(PLAIN | LOOKS[look])), rows=24)], lights=[LIGHT])
    shown = [frame(scene, p, max_bounces=0, energy_compensation=compensated) for p in SAMPLED]
    for other in shown[1:]:
        np.testing.assert_allclose(other, shown[0], rtol=2e-3, atol=2e-4)
    plain = ls.MaterialPbr(**(PLAIN | (LOOKS[look] if compensated else {})))
    without = frame(ls.Scene(meshes=[ball(0.3, plain, rows=24)], lights=[LIGHT]), ls.Pipeline.TRACE)
    assert np.abs(without - shown[0]).max() > 0.02


def test_sheen_of_a_material_makes_relit_gaussians_brighter() -> None:
    """The mean colour of a relit ball rises by more than 0.005."""
    gaussians = ls.gaussians_from_mesh(ball(0.3, ls.MaterialPbr(base_color=(0.5, 0.1, 0.1))), 3000)
    shown = [
        frame(ls.Scene(splats=[ls.SplatInstance(gaussians, material=material)], lights=[LIGHT]), ls.Pipeline.HYBRID)
        for material in (ls.MaterialPbr(**PLAIN), ls.MaterialPbr(**(PLAIN | LOOKS["sheen"])))
    ]
    assert shown[1].mean() > shown[0].mean() + 0.005


def test_path_traced_clearcoat_reflects_4_percent_of_a_lit_wall() -> None:
    """The coat lies over a black base and reflects a wall behind the camera at normal incidence."""
    coated = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), specular=0.0, roughness=1.0, clearcoat=1.0)
    dark = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), specular=0.0, roughness=1.0, emissive=(1.0, 1.0, 1.0))
    scene = ls.Scene(
        meshes=[
            quad((-1, -1, 0.0), (0, 2, 0), (2, 0, 0), coated),
            quad((-9, -9, -4.0), (18, 0, 0), (0, 18, 0), dark),
        ]
    )
    np.testing.assert_allclose(frame(scene, ls.Pipeline.PATH, 16, max_bounces=2).mean(), 0.04, rtol=0.02)
