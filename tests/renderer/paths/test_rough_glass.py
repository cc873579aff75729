"""Paths through rough glass, as a body and as a wall, against closed forms and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, ball, diffuse, paths, quad

FROSTED = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.3, transmission=1.0, ior=1.5)
VIEW = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=48, height=32, fov_y=0.3)


def test_a_frosted_ball_in_a_furnace() -> None:
    """In even light it can hardly be seen: what single scattering loses is little at this roughness."""
    scene = ls.Scene(meshes=[ball(0.3, FROSTED, rows=24)], lights=[ls.LightEnvironment(color=(0.7, 0.7, 0.7))])
    values = paths(scene, VIEW, 64, 32).color[8:24, 12:36, 1].astype(np.float64) / 0.7
    assert values.std() / np.sqrt(values.size) < 0.004
    assert 0.97 < values.mean() < 1.003


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize("lamp", ["mesh", "rect", "sky", "point"])
def test_what_comes_through_frosted_panes(lamp: str, thin: bool) -> None:
    """By samples of lights or by rays that meet them, weighted: the same light as by the latter alone.

    A point lights a wall by samples only; it is compared with a small sphere of the same candela.
    """
    lights: dict[str, list[ls.LightRect | ls.LightSphere | ls.LightPoint | ls.LightEnvironment]] = {
        "mesh": [],
        "rect": [ls.LightRect((0.0, 0.0, 1.0), (1, 0, 0), (0, -1, 0), intensity=1.0)],
        "sky": [ls.LightEnvironment(color=(0.3, 0.3, 0.3))],
        "point": [ls.LightPoint((0.0, 0.0, 1.0), intensity=0.2)],
    }
    shining = [quad((-0.5, -0.5, 1.0), (0, 1, 0), (1, 0, 0), diffuse(0.0, 1.0))] if lamp == "mesh" else []
    if thin:
        glass = quad((-4, -4, 0.0), (8, 0, 0), (0, 8, 0), replace(FROSTED, thin_walled=True))
    else:
        box = ls.box(np.array([8.0, 8.0, 0.1]))
        glass = replace(box, material=FROSTED)
    view = ls.Camera.look_at((0, 0, -2), (0, 0, 0), width=48, height=32, fov_y=0.05)
    shown = paths(ls.Scene(meshes=[*shining, glass], lights=lights[lamp]), view, 256, 8, background=None)
    values = shown.color[..., 1].astype(np.float64)
    assert values.mean() > 0.02
    if lamp == "sky":
        assert_is(values / 0.3, values.mean() / 0.3)
        assert 0.93 < values.mean() / 0.3 <= 1.003
        return
    alone = ls.LightSphere((0.0, 0.0, 1.0), 0.02, intensity=0.2 / (np.pi * 0.02**2))
    other = [ls.LightRect((0.0, 0.0, 1.0), (1, 0, 0), (0, -1, 0), intensity=1.0)] if lamp != "point" else [alone]
    if lamp == "rect":
        shining = [quad((-0.5, -0.5, 1.0), (0, 1, 0), (1, 0, 0), diffuse(0.0, 1.0))]
        other = []
    twin = paths(ls.Scene(meshes=[*shining, glass] if lamp == "rect" else [glass], lights=other), view, 256, 8)
    expected = twin.color[..., 1].astype(np.float64)
    error = np.hypot(values.std(), expected.std()) / np.sqrt(values.size)
    assert error < 0.03 * expected.mean()
    np.testing.assert_allclose(values.mean(), expected.mean(), atol=4.0 * error)


def test_other_pipelines_scatter_it_back() -> None:
    """There, what rough glass does not mirror is diffuse, as it was: paths alone show what is behind."""
    wall = quad((-4, -4, 1.0), (8, 0, 0), (0, 8, 0), diffuse(0.0, 1.0))
    pane = quad((-4, -4, 0.0), (8, 0, 0), (0, 8, 0), replace(FROSTED, thin_walled=True))
    scene = ls.Scene(meshes=[wall, pane], lights=[ls.LightEnvironment(color=(0.1, 0.1, 0.1))])
    assert paths(scene, VIEW, 16, 4).color.mean() > 0.8
    for pipeline in (ls.Pipeline.TRACE, ls.Pipeline.HYBRID):
        settings = ls.RenderConfig(pipeline=pipeline, samples=1, lighting=True)
        assert ls.render(scene, VIEW, settings, device="cpu").color.max() < 0.5
