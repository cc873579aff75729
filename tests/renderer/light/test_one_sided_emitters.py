"""Meshes that emit only from the front of their triangles: camera view, light sampling and hits agree."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, ball, diffuse, paths, quad

EMITTED = 2.0
LIGHT = replace(diffuse(0.0, EMITTED), double_sided=False)
DOWN_AT_FLOOR = ls.Camera.look_at((0.0, 0.4, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), width=16, height=16, fov_y=0.02)
DARK = ls.LightPoint((0.0, 50.0, 0.0), intensity=1e-9)
"""Light so weak that it only makes frames lit."""


def panel(material: ls.MaterialPbr, *, faces_down: bool = True) -> ls.Mesh:
    """Returns a square of side 1 at a height of 1."""
    along, across = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)) if faces_down else ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    return quad((-0.5, 1.0, -0.5), along, across, material)


def floor_below(material: ls.MaterialPbr, *, faces_down: bool, mirrored: bool = False) -> ls.Scene:
    """Returns an emitting panel over a floor."""
    transform = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
    floor = quad((-4.0, 0.0, -4.0), (0.0, 0.0, 8.0), (8.0, 0.0, 0.0), diffuse(0.5))
    light = ls.MeshInstance(panel(material, faces_down=faces_down), transform)
    return ls.Scene((), [ls.MeshInstance(floor), light], [DARK])


def form_factor() -> float:
    """Returns the form factor from a point to a square of side 1 above it, at a distance of 1."""
    a = 0.5
    return 4.0 / (2.0 * math.pi) * 2.0 * a / math.sqrt(1.0 + a * a) * math.atan(a / math.sqrt(1.0 + a * a))


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_back_of_a_one_sided_emitter_is_black(pipeline: ls.Pipeline) -> None:
    """The front shows the emission in every pipeline and in the emission image; a mirrored instance likewise."""
    camera = ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), width=8, height=8, fov_y=0.3)
    config = ls.RenderConfig(pipeline=pipeline, aovs=("emission",))
    for faces_down, mirrored in ((True, False), (False, False), (True, True)):
        light = ls.MeshInstance(
            panel(LIGHT, faces_down=faces_down), np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0, 1.0])
        )
        frame = ls.render(ls.Scene((), [light], [DARK]), camera, config, device="cpu")
        expected = EMITTED if faces_down else 0.0
        np.testing.assert_allclose(frame.color, expected, atol=1e-5)
        assert frame.emission is not None
        np.testing.assert_allclose(frame.emission, expected, atol=1e-5)


def test_one_sided_emitter_lights_a_surface_in_front_by_its_form_factor_and_none_behind() -> None:
    """Radiance is albedo times emission times form factor in front, and 0 behind the back."""
    expected = 0.5 * EMITTED * form_factor()
    for mirrored in (False, True):
        lit = paths(floor_below(LIGHT, faces_down=True, mirrored=mirrored), DOWN_AT_FLOOR, 64, 1)
        assert_is(lit.color[..., 0], expected)
        back = paths(floor_below(LIGHT, faces_down=False, mirrored=mirrored), DOWN_AT_FLOOR, 64, 4)
        assert back.color.max() < 1e-6
    both = paths(floor_below(replace(LIGHT, double_sided=True), faces_down=False), DOWN_AT_FLOOR, 64, 1)
    assert_is(both.color[..., 0], expected)


@pytest.mark.parametrize("roughness", [0.1, 1.0])
def test_light_in_front_of_a_one_sided_emitter_equals_that_of_a_two_sided_one(roughness: float) -> None:
    """The bits are equal whether samples of lights or samples of a highlight find the emitter."""
    shown = []
    for double_sided in (False, True):
        scene = floor_below(replace(LIGHT, double_sided=double_sided), faces_down=True)
        floor = replace(scene.meshes[0].mesh, material=ls.MaterialPbr(metallic=1.0, roughness=roughness))
        scene = replace(scene, meshes=(ls.MeshInstance(floor), scene.meshes[1]))
        shown.append(paths(scene, DOWN_AT_FLOOR, 16, 1).color)
    np.testing.assert_array_equal(*shown)
    assert shown[0].mean() > 0.05


def test_radiance_inside_an_emitting_ball_equals_the_geometric_series() -> None:
    """Radiance is emission over one minus albedo in all directions; 0 if the ball emits outwards, except at edges."""
    camera = ls.Camera.look_at((0.1, 0.2, 0.0), (1.0, 0.3, 0.2), (0.0, 1.0, 0.0), width=24, height=24, fov_y=1.0)
    material = replace(diffuse(0.5, 1.0), double_sided=False)
    inwards = paths(ls.Scene((), [ls.MeshInstance(ball(1.0, material, hollow=True))]), camera, 16, 24)
    assert_is(inwards.color[..., 0], 2.0, share=0.02)
    outwards = paths(ls.Scene((), [ls.MeshInstance(ball(1.0, material))]), camera, 4, 8)
    assert outwards.color.mean() < 1e-5


def test_one_sided_emitter_in_real_time_lights_surfaces_in_front_and_none_behind() -> None:
    """Light in front is within 3 % of path tracing, and there is none behind."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), "cpu")
    lit, back = floor_below(LIGHT, faces_down=True), floor_below(LIGHT, faces_down=False)
    frames = [renderer.render(lit, DOWN_AT_FLOOR).color.astype(np.float64) for _ in range(24)]
    assert np.mean(frames[8:]) == pytest.approx(0.5 * EMITTED * form_factor(), rel=0.03)
    dark = [renderer.render(back, DOWN_AT_FLOOR).color.max() for _ in range(24)]
    assert dark[-1] < 1e-3
