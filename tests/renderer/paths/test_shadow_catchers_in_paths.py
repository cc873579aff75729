"""Shadow catchers in path tracing: light that added objects block, and light that they add."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, diffuse, paths, wide_sheet

RADIUS, HEIGHT = 0.5, 0.4
SHARE = RADIUS**2 / (RADIUS**2 + HEIGHT**2)
"""Fraction of a cosine-weighted hemisphere that the disc hides from the point below it."""


def captured_sheet(y: float, color: float, *, size: float = 1e4, shadow_catcher: bool = True) -> ls.SplatInstance:
    """Returns a level sheet that emits a captured grey, display-referred, with alpha 0.99."""
    sheet = replace(wide_sheet(y, 0.99, 0.5).gaussians, scales=np.array([[size, size, 1e-4]]))
    sh = np.full((1, 1, 3), (color - 0.5) / 0.28209479177387814, np.float32)
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    return ls.SplatInstance(replace(sheet, sh=sh, albedo=None, normals=None), turn, shadow_catcher=shadow_catcher)


def disc(material: ls.MaterialPbr) -> ls.Mesh:
    """Returns a level disc with many corners above the origin."""
    angles = np.linspace(0.0, 2.0 * np.pi, 129)[:-1]
    rim = np.stack([RADIUS * np.cos(angles), np.full(128, HEIGHT), RADIUS * np.sin(angles)], axis=1)
    corners = np.concatenate([[[0.0, HEIGHT, 0.0]], rim])
    faces = [[0, 1 + k, 1 + (k + 1) % 128] for k in range(128)]
    return ls.Mesh(corners, np.array(faces), material=material)


def below() -> ls.Camera:
    """Returns a camera on the floor below the disc."""
    return ls.Camera.look_at((0.0, 0.3, 0.0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.02)


def factor(scene: ls.Scene, samples: int = 64, bounces: int = 1, **changes: object) -> npt.NDArray[np.float64]:
    """Returns the ratio of the floor's radiance to the captured radiance, one value per pixel."""
    frame = paths(scene, below(), samples, bounces, **changes)
    captured = paths(ls.Scene(scene.splats[:1]), below(), 1, 0).color
    values: npt.NDArray[np.float64] = (frame.color / captured)[..., 1].astype(np.float64)
    return values


@pytest.mark.parametrize("source", ["sky", "ceiling"])
def test_black_disc_blocks_its_form_factor_on_a_path_traced_shadow_catcher(source: str) -> None:
    """The disc blocks light of the environment and of a captured ceiling; the scene has no light source."""
    black = diffuse(0.0)
    if source == "sky":
        scene = ls.Scene(
            [captured_sheet(0.0, 0.5)],
            meshes=[disc(black)],
            lights=[ls.LightEnvironment(color=(0.7, 0.8, 0.9), visible=False)],
        )
    else:
        # The floor is small, so that the ceiling does not count as part of its layer.
        scene = ls.Scene([captured_sheet(0.0, 0.5, size=0.5), captured_sheet(3.0, 0.8)], meshes=[disc(black)])
    assert_is(factor(scene), 1.0 - SHARE)


def test_emissive_disc_adds_its_light_to_a_path_traced_shadow_catcher() -> None:
    """The disc is twice as bright as the environment, so that it adds as much light as it blocks."""
    scene = ls.Scene(
        [captured_sheet(0.0, 0.5)],
        meshes=[disc(diffuse(0.0, 2.0))],
        lights=[ls.LightEnvironment(color=(1, 1, 1), visible=False)],
    )
    assert_is(factor(scene), 1.0 + SHARE)


def test_white_disc_reflects_light_of_the_floor_to_a_path_traced_shadow_catcher() -> None:
    """A white disc is lit by the captured floor, and its reflection lights the floor in turn."""
    shines = 0.99 * ((0.5 + 0.055) / 1.055) ** 2.4 + 0.01
    scene = ls.Scene(
        [captured_sheet(0.0, 0.5)],
        meshes=[disc(diffuse(0.8))],
        lights=[ls.LightEnvironment(color=(1, 1, 1), visible=False)],
    )
    # The underside of the disc gets the captured light of the wide floor, and environment light beyond the floor.
    assert_is(factor(scene, 128), 1.0 - SHARE + SHARE * 0.8 * shines, share=0.02)


def test_shadow_ratio_of_a_shadow_catcher_is_equal_by_path_tracing_and_other_pipelines() -> None:
    """Below a disc in sunlight, unblocked ambient light remains, or the unblocked part of an environment."""
    sun = ls.LightDirectional((0, -1, 0), intensity=2.0)
    scene = ls.Scene([captured_sheet(0.0, 0.5)], meshes=[disc(diffuse(0.0))], lights=[sun])
    assert_is(factor(scene, 128), 0.5 * np.pi * (1.0 - SHARE) / (0.5 * np.pi + 2.0), share=0.02)
    both = replace(scene, lights=[sun, ls.LightEnvironment(color=(1, 1, 1), visible=False)])
    assert_is(factor(both, 128), np.pi * (1.0 - SHARE) / (np.pi + 2.0), share=0.02)


def test_object_hidden_below_a_captured_floor_does_not_change_the_path_traced_frame() -> None:
    """The captured floor and ceiling have equal bits with and without a disc below the floor."""
    scene = ls.Scene(
        [captured_sheet(0.0, 0.5, size=0.5), captured_sheet(3.0, 0.8)],
        lights=[ls.LightEnvironment(color=(0.3, 0.4, 0.5), visible=False)],
    )
    under = disc(diffuse(0.5)).positions + np.array([9.0, -2.0, 0.0])
    hidden = replace(disc(diffuse(0.5)), positions=under)
    frames = [paths(replace(scene, meshes=meshes), below(), 8, 3) for meshes in ((), (hidden,))]
    np.testing.assert_array_equal(frames[0].color, frames[1].color)


def test_added_black_capture_blocks_light_on_a_path_traced_shadow_catcher() -> None:
    """The added capture is emissive, black and no catcher."""
    scene = ls.Scene(
        [captured_sheet(0.0, 0.5, size=0.5), captured_sheet(3.0, 0.8), captured_sheet(2.5, 0.0, shadow_catcher=False)]
    )
    left = factor(scene)
    assert left.max() < 0.02


def test_emissive_disc_adds_light_to_a_path_traced_shadow_catcher_without_environment() -> None:
    """The disc's light is relative to the least irradiance that explains the floor: pi times its radiance."""
    scene = ls.Scene([captured_sheet(0.0, 0.5)], meshes=[disc(diffuse(0.0, 2.0))])
    least = np.pi * paths(ls.Scene(scene.splats), below(), 1, 0).color.mean()
    assert_is(factor(scene), 1.0 + 2.0 * np.pi * SHARE / least, share=0.02)


@pytest.mark.parametrize("visible", [True, False])
def test_clear_pane_does_not_change_the_light_on_a_path_traced_shadow_catcher(visible: bool) -> None:
    """A pane of index 1 is between a light and the floor, whether or not rays can hit the light."""
    clear = ls.MaterialPbr(base_color=(1, 1, 1), transmission=1.0, roughness=0.0, ior=1.0, specular=0.0)
    light = ls.LightRect((0, 2, 0), (1, 0, 0), (0, 0, 1), intensity=20.0, visible=visible)
    scene = ls.Scene([captured_sheet(0.0, 0.5)], meshes=[disc(clear)], lights=[light])
    assert_is(factor(scene, 128), 1.0, share=0.02)


def test_path_traced_edge_pixels_blend_object_and_shadow_catcher_by_coverage() -> None:
    """A partly covered pixel shows that fraction of the object, and the floor with the brightness of its neighbours."""
    black = diffuse(0.0)
    lid = replace(disc(black), positions=disc(black).positions * np.array([200.0, 1.0, 200.0]))
    edge = disc(black).positions * np.array([0.2, 0.0, 0.2]) + np.array([0.12, 0.05, 0.0])
    scene = ls.Scene(
        [captured_sheet(0.0, 0.5)],
        meshes=[lid, replace(disc(black), positions=edge)],
        lights=[ls.LightEnvironment(color=(0.1, 0.1, 0.1), visible=False)],
    )
    view = ls.Camera.look_at((0.0, 0.3, 0.0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.3)
    frame = paths(scene, view, 64, 0)
    # The floor must have received more light than the dim environment gives: only the environment's light is removed.
    captured = paths(ls.Scene(scene.splats), below(), 1, 0).color.mean()
    left = 1.0 - np.pi * 0.1 / (np.pi * captured)
    floor = paths(scene, below(), 64, 0).color.mean()
    np.testing.assert_allclose(floor, left * captured, rtol=0.02)
    assert frame.captured_weight is not None
    share = frame.captured_weight[..., None]
    mixed = (share > 0.2) & (share < 0.8)
    assert mixed.sum() > 5
    np.testing.assert_allclose(
        (frame.color / np.maximum(share, 0.2))[np.broadcast_to(mixed, frame.color.shape)], floor, rtol=0.05
    )
