"""Shadow-only captures in frames of paths: what added objects take of the light of the place, and what they add."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from support.scenes.path_scenes import assert_is, diffuse, paths, wide_sheet

RADIUS, HEIGHT = 0.5, 0.4
SHARE = RADIUS**2 / (RADIUS**2 + HEIGHT**2)
"""Of a cosine-weighted hemisphere that the disc hides from the point below it."""


def place(y: float, color: float, *, size: float = 1e4, shadow_catcher: bool = True) -> ls.SplatInstance:
    """A level sheet that shows a grey as captured, display-referred; it covers 0.99 of what is behind."""
    sheet = replace(wide_sheet(y, 0.99, 0.5).gaussians, scales=np.array([[size, size, 1e-4]]))
    sh = np.full((1, 1, 3), (color - 0.5) / 0.28209479177387814, np.float32)
    turn = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)
    return ls.SplatInstance(replace(sheet, sh=sh, albedo=None, normals=None), turn, shadow_catcher=shadow_catcher)


def disc(material: ls.MaterialPbr) -> ls.Mesh:
    """A level disc above the origin, of many corners."""
    angles = np.linspace(0.0, 2.0 * np.pi, 129)[:-1]
    rim = np.stack([RADIUS * np.cos(angles), np.full(128, HEIGHT), RADIUS * np.sin(angles)], axis=1)
    corners = np.concatenate([[[0.0, HEIGHT, 0.0]], rim])
    faces = [[0, 1 + k, 1 + (k + 1) % 128] for k in range(128)]
    return ls.Mesh(corners, np.array(faces), material=material)


def below() -> ls.Camera:
    """Sees the floor under the disc."""
    return ls.Camera.look_at((0.0, 0.3, 0.0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.02)


def factor(scene: ls.Scene, samples: int = 64, bounces: int = 1, **changes: object) -> npt.NDArray[np.float64]:
    """What is left of the captured floor, or more than that, one value a pixel."""
    frame = paths(scene, below(), samples, bounces, **changes)
    captured = paths(ls.Scene(scene.splats[:1]), below(), 1, 0).color
    values: npt.NDArray[np.float64] = (frame.color / captured)[..., 1].astype(np.float64)
    return values


@pytest.mark.parametrize("source", ["sky", "ceiling"])
def test_a_black_disc_takes_what_it_hides(source: str) -> None:
    """Of the sky's light, and of the light that the captured ceiling shines: the form factor, without any lamp."""
    black = diffuse(0.0)
    if source == "sky":
        scene = ls.Scene(
            [place(0.0, 0.5)], meshes=[disc(black)], lights=[ls.LightEnvironment(color=(0.7, 0.8, 0.9), visible=False)]
        )
    else:
        # A floor as small as that is not taken for the layer that the ceiling is in.
        scene = ls.Scene([place(0.0, 0.5, size=0.5), place(3.0, 0.8)], meshes=[disc(black)])
    assert_is(factor(scene), 1.0 - SHARE)


def test_a_disc_that_shines_adds_its_light() -> None:
    """Twice as bright as the sky: as much more as it hides."""
    scene = ls.Scene(
        [place(0.0, 0.5)],
        meshes=[disc(diffuse(0.0, 2.0))],
        lights=[ls.LightEnvironment(color=(1, 1, 1), visible=False)],
    )
    assert_is(factor(scene), 1.0 + SHARE)


def test_a_disc_gives_back_what_the_floor_shines() -> None:
    """Colour bleeding: below a white disc, the captured floor lights it and gets light back."""
    shines = 0.99 * ((0.5 + 0.055) / 1.055) ** 2.4 + 0.01
    scene = ls.Scene(
        [place(0.0, 0.5)], meshes=[disc(diffuse(0.8))], lights=[ls.LightEnvironment(color=(1, 1, 1), visible=False)]
    )
    # From below, the disc sees the wide floor alone, only its captured light, and some of the sky behind.
    assert_is(factor(scene, 128), 1.0 - SHARE + SHARE * 0.8 * shines, share=0.02)


def test_a_lamp_is_shadowed_as_in_the_other_pipelines() -> None:
    """Of a sun alone, ambient light is left, as far as the disc leaves it; of a sun and a sky, the rest of the sky."""
    sun = ls.LightDirectional((0, -1, 0), intensity=2.0)
    scene = ls.Scene([place(0.0, 0.5)], meshes=[disc(diffuse(0.0))], lights=[sun])
    assert_is(factor(scene, 128), 0.5 * np.pi * (1.0 - SHARE) / (0.5 * np.pi + 2.0), share=0.02)
    both = replace(scene, lights=[sun, ls.LightEnvironment(color=(1, 1, 1), visible=False)])
    assert_is(factor(both, 128), np.pi * (1.0 - SHARE) / (np.pi + 2.0), share=0.02)


def test_nothing_changes_where_nothing_was_added() -> None:
    """To the bit: the captured floor and ceiling, and a disc below the floor that is not in the picture."""
    scene = ls.Scene(
        [place(0.0, 0.5, size=0.5), place(3.0, 0.8)], lights=[ls.LightEnvironment(color=(0.3, 0.4, 0.5), visible=False)]
    )
    under = disc(diffuse(0.5)).positions + np.array([9.0, -2.0, 0.0])
    hidden = replace(disc(diffuse(0.5)), positions=under)
    frames = [paths(replace(scene, meshes=meshes), below(), 8, 3) for meshes in ((), (hidden,))]
    np.testing.assert_array_equal(frames[0].color, frames[1].color)


def test_a_capture_that_is_added_takes_light_too() -> None:
    """A kept set that is not shadow-only: black, it takes all of the light that would come from above."""
    scene = ls.Scene([place(0.0, 0.5, size=0.5), place(3.0, 0.8), place(2.5, 0.0, shadow_catcher=False)])
    left = factor(scene)
    assert left.max() < 0.02


def test_a_disc_that_shines_needs_no_sky() -> None:
    """Its light counts against the least that the floor must have received: pi times what it shines."""
    scene = ls.Scene([place(0.0, 0.5)], meshes=[disc(diffuse(0.0, 2.0))])
    least = np.pi * paths(ls.Scene(scene.splats), below(), 1, 0).color.mean()
    assert_is(factor(scene), 1.0 + 2.0 * np.pi * SHARE / least, share=0.02)


@pytest.mark.parametrize("visible", [True, False])
def test_clear_glass_changes_nothing(visible: bool) -> None:
    """A pane of index 1 between a lamp and the floor: its light counts once, whether or not rays meet the lamp."""
    clear = ls.MaterialPbr(base_color=(1, 1, 1), transmission=1.0, roughness=0.0, ior=1.0, specular=0.0)
    lamp = ls.LightRect((0, 2, 0), (1, 0, 0), (0, 0, 1), intensity=20.0, visible=visible)
    scene = ls.Scene([place(0.0, 0.5)], meshes=[disc(clear)], lights=[lamp])
    assert_is(factor(scene, 128), 1.0, share=0.02)


def test_a_silhouette_before_a_dark_floor() -> None:
    """Pixels of which an object covers a part show that part, and of the floor no more than their neighbours do."""
    black = diffuse(0.0)
    lid = replace(disc(black), positions=disc(black).positions * np.array([200.0, 1.0, 200.0]))
    edge = disc(black).positions * np.array([0.2, 0.0, 0.2]) + np.array([0.12, 0.05, 0.0])
    scene = ls.Scene(
        [place(0.0, 0.5)],
        meshes=[lid, replace(disc(black), positions=edge)],
        lights=[ls.LightEnvironment(color=(0.1, 0.1, 0.1), visible=False)],
    )
    view = ls.Camera.look_at((0.0, 0.3, 0.0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.3)
    frame = paths(scene, view, 64, 0)
    # As little sky as that is less than what the floor must have received: all of it is lost, and not more.
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
