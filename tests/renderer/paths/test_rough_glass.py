"""Paths through rough glass, as a body and as a pane, compared with closed forms and with each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.scenes.path_scenes import ball, diffuse, paths, quad

FROSTED = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.3, transmission=1.0, ior=1.5)
VIEW = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=48, height=32, fov_y=0.3)


def test_frosted_glass_ball_nearly_disappears_in_a_white_furnace() -> None:
    """Single scattering loses little energy at the roughness of the ball."""
    scene = ls.Scene(meshes=[ball(0.3, FROSTED, rows=24)], lights=[ls.LightEnvironment(color=(0.7, 0.7, 0.7))])
    values = paths(scene, VIEW, 64, 32).color[8:24, 12:36, 1].astype(np.float64) / 0.7
    assert values.std() / np.sqrt(values.size) < 0.004
    assert 0.97 < values.mean() < 1.003


EMITTER = quad((-0.5, -0.5, 1.0), (0, 1, 0), (1, 0, 0), diffuse(0.0, 1.0))
RECT = ls.LightRect((0.0, 0.0, 1.0), (1, 0, 0), (0, -1, 0), intensity=1.0)
ENVIRONMENT = ls.LightEnvironment(color=(0.3, 0.3, 0.3))
LIGHTS: dict[str, tuple[Light | ls.Mesh, Light]] = {
    "mesh": (EMITTER, replace(RECT, visible=False)),
    "rect": (RECT, replace(RECT, visible=False)),
    "sky": (ENVIRONMENT, replace(ENVIRONMENT, shadow_distance=1e6)),
    "sphere": (
        ls.LightSphere((0.0, 0.0, 1.0), 0.02, intensity=0.2 / (np.pi * 0.02**2)),
        ls.LightPoint((0.0, 0.0, 1.0), intensity=0.2),
    ),
}
"""Light that rays can hit, and an equal light that is only sampled."""


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize(
    "source", ["sky", *(pytest.param(name, marks=pytest.mark.deep) for name in LIGHTS if name != "sky")]
)
def test_light_through_frosted_panes_is_equal_for_light_samples_and_rays_that_hit_lights(
    source: str, thin: bool
) -> None:
    """Multiple importance sampling of light samples and hits equals light sampling alone."""
    pane = quad((-4, -4, 0.0), (8, 0, 0), (0, 8, 0), diffuse(0.0)) if thin else ls.box(np.array([8.0, 8.0, 0.1]))
    glass = replace(pane, material=replace(FROSTED, roughness=0.5, thin_walled=thin))
    view = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=32, height=24, fov_y=0.05)
    values = []
    for light in LIGHTS[source]:
        is_mesh = isinstance(light, ls.Mesh)
        scene = ls.Scene(meshes=[glass, light] if is_mesh else [glass], lights=[] if is_mesh else [light])
        values.append(paths(scene, view, 256, 8, background=None).color[..., 1].astype(np.float64))
    both, sampled = values
    error = np.hypot(both.std(), sampled.std()) / np.sqrt(both.size)
    assert error < 0.03 * sampled.mean()
    np.testing.assert_allclose(both.mean(), sampled.mean(), atol=4.0 * error)
    if source == "sky":  # white furnace except for the loss of single scattering
        smoother = replace(glass, material=replace(glass.material, roughness=0.3))
        furnace = paths(ls.Scene(meshes=[smoother], lights=[ENVIRONMENT]), view, 64, 8, background=None).color
        assert 0.93 < furnace.mean() / 0.3 <= 1.003


def test_diffuse_reflection_replaces_rough_glass_in_pipelines_other_than_path() -> None:
    """Without path tracing, transmitted light becomes diffuse reflection."""
    wall = quad((-4, -4, 1.0), (8, 0, 0), (0, 8, 0), diffuse(0.0, 1.0))
    pane = quad((-4, -4, 0.0), (8, 0, 0), (0, 8, 0), replace(FROSTED, thin_walled=True))
    scene = ls.Scene(meshes=[wall, pane], lights=[ls.LightEnvironment(color=(0.1, 0.1, 0.1))])
    assert paths(scene, VIEW, 16, 4).color.mean() > 0.8
    for pipeline in (ls.Pipeline.TRACE, ls.Pipeline.HYBRID):
        settings = ls.RenderConfig(pipeline=pipeline, samples=1, lighting=True)
        assert ls.render(scene, VIEW, settings, device="cpu").color.max() < 0.5
