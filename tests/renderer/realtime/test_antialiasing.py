"""Antialiasing over frames: against pictures of many samples a pixel, while things stand still, move and fade."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import checker_quad, front_camera, one_gaussian, quad, random_gaussians, similarity

Doubles = npt.NDArray[np.float64]

CAMERA = front_camera()
LAMP = ls.LightPoint((0.0, 0.0, -50.0), intensity=1e-6)
"""Of no account: what is seen shines, and makes no noise."""
PARTS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy", "emission")


def shining(*radiance: float, half: float = 1.0, tilt: float = 0.0) -> ls.Mesh:
    """A square that shines."""
    material = ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), emissive=radiance)  # pyright: ignore[reportArgumentType]
    return quad(4.0, half, tilt, material=material)


def renderer(antialiasing: bool = True, threads: int = 1, **settings: object) -> ls.Renderer:
    """Of a sequence without bounces."""
    realtime = ls.RealtimeConfig(antialiasing=antialiasing)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, realtime=realtime, **settings)  # pyright: ignore[reportArgumentType]
    return ls.create_renderer(config, "cpu", threads=threads)


def scene_of(*meshes: ls.Mesh | ls.MeshInstance, **settings: object) -> ls.Scene:
    """Something that shines before black."""
    return ls.Scene((), meshes, [LAMP], **settings)  # pyright: ignore[reportArgumentType]


def truth(scene: ls.Scene, camera: ls.Camera = CAMERA) -> ls.Frame:
    """Many samples a pixel."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=64, max_bounces=0, lighting=True)
    return ls.create_renderer(config, "cpu", threads=1).render(scene, camera)


def error(frame: ls.Frame, of: ls.Frame) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean((frame.color - of.color) ** 2)))


def test_edges_that_stand_still_become_smooth() -> None:
    """The first frame has one sample a pixel, at its centre; the mean over frames is nearly that of the truth."""
    scene = scene_of(
        replace(shining(0.8, 0.5, 0.2, tilt=0.5), positions=np.array(shining(1.0, 1.0, 1.0).positions) * 0.9 + 0.07)
    )
    sharp, smooth = renderer(antialiasing=False).render(scene, CAMERA), renderer(aovs=PARTS)
    frames = [smooth.render(scene, CAMERA) for _ in range(48)]
    np.testing.assert_array_equal(frames[0].color, sharp.color)
    good = truth(scene)
    assert error(sharp, good) > 0.02
    assert error(frames[16], good) < 0.4 * error(sharp, good)
    assert error(frames[47], good) < 0.15 * error(sharp, good)
    np.testing.assert_allclose(frames[47].alpha, good.alpha, atol=0.08)
    flicker = np.std([frame.color.mean(axis=2) for frame in frames[32:]], axis=0)
    assert flicker.max() < 0.02
    total = sum(np.asarray(getattr(frames[47], part), np.float64) for part in PARTS)
    np.testing.assert_allclose(total, frames[47].color, atol=1e-5, rtol=1e-5)


def test_what_shows_unlit_is_smooth_as_well() -> None:
    """Captures that keep their look, and an environment behind them and a mesh."""
    rng = np.random.default_rng(2)
    sky = ls.LightEnvironment(rng.uniform(0.0, 1.0, (16, 32, 3)).astype(np.float32))
    scene = ls.Scene([random_gaussians(4, count=60)], [shining(0.7, 0.1, 0.1, half=0.5)], [sky])
    good, sharp, smooth = truth(scene), renderer(antialiasing=False), renderer()
    assert error(sharp.render(scene, CAMERA), good) > 0.005
    frames = [smooth.render(scene, CAMERA) for _ in range(40)]
    assert error(frames[-1], good) < 0.25 * error(frames[0], good)


def test_thin_things_do_not_flicker() -> None:
    """A wire a quarter of a pixel wide is hit by one frame of four: all show it, and as bright as it is."""
    wire = replace(
        shining(1.0, 1.0, 1.0),
        positions=np.array(shining(1.0, 1.0, 1.0).positions) * (0.0083, 1.0, 1.0) + (0.03, 0.0, 0.0),
    )
    scene, smooth = scene_of(wire), renderer()
    frames = np.array([smooth.render(scene, CAMERA).color[..., 0] for _ in range(80)])[48:, 14:34]
    good = truth(scene).color[14:34, :, 0]
    assert good.max() == pytest.approx(0.25, abs=0.08)
    np.testing.assert_allclose(frames.mean(axis=0), good, atol=0.04)
    assert frames.std(axis=0).max() < 0.05


def test_what_has_gone_leaves_no_trail() -> None:
    """Where a thing was, and is not any more, is the background: at once but at its edges, and there in a frame."""
    mesh = shining(1.0, 1.0, 1.0, half=0.5)
    away = similarity(offset=(1.2, 0.0, 0.0))
    smooth, first = renderer(), scene_of(ls.MeshInstance(mesh))
    for _ in range(20):
        smooth.render(first, CAMERA)
    gone = [smooth.render(scene_of(ls.MeshInstance(mesh, away)), CAMERA) for _ in range(3)]
    empty = truth(scene_of(ls.MeshInstance(mesh, away))).alpha == 0.0
    for frame, most in zip(gone, (0.005, 0.001, 0.001), strict=True):
        assert frame.color[empty].max() <= most


@pytest.mark.parametrize("goes", [True, False])
def test_what_starts_to_move_or_goes_leaves_no_outline(goes: bool) -> None:
    """Its edges were means of it and of what is behind: where it is not any more, that alone is seen, at once."""
    mesh, wall = shining(0.3, 0.3, 0.3, half=0.5, tilt=0.4), shining(0.8, 0.8, 0.8, half=6.0)
    behind = ls.MeshInstance(wall, similarity(offset=(0.0, 0.0, 2.0)))
    turned = [similarity((0.0, 0.0, 1.0), 0.3, offset=(x, 0.0, 0.0)) for x in (0.0, 0.4)]
    first, then = ([ls.MeshInstance(mesh, at)] for at in turned)
    smooth = renderer()
    for _ in range(40):
        smooth.render(scene_of(*first, behind), CAMERA)
    then = [] if goes else then
    frame = smooth.render(scene_of(*then, behind), CAMERA)
    away = truth(scene_of(*then)).alpha == 0.0 if then else np.ones(frame.color.shape[:2], bool)
    near = np.pad(~away, 2)
    near = np.any([np.roll(near, (y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)], axis=0)[2:-2, 2:-2]
    np.testing.assert_allclose(frame.color[~near], 0.8, atol=0.01)


@pytest.mark.parametrize("step", [0.03, 0.2])
def test_what_moves_has_smooth_edges_and_no_trail(step: float) -> None:
    """Half a pixel or three a frame: nearer to the truth than single samples, and nothing far from the edges."""
    mesh, smooth, sharp = shining(0.9, 0.6, 0.3, half=0.5, tilt=0.4), renderer(), renderer(antialiasing=False)
    turned = [similarity((0.0, 0.0, 1.0), 0.3, offset=(1.2 - step * left, -1.0, 0.4)) for left in range(11, -1, -1)]
    scenes = [scene_of(ls.MeshInstance(mesh, at)) for at in turned]
    frames = [[each.render(scene, CAMERA) for scene in scenes][-1] for each in (smooth, sharp)]
    good = truth(scenes[-1])
    assert error(frames[0], good) < 0.7 * error(frames[1], good)
    shown = np.pad(good.alpha, 2) > 0.0
    near = np.any([np.roll(shown, (y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)], axis=0)[2:-2, 2:-2]
    assert np.abs(frames[0].color[~near]).max() < 1e-3


@pytest.mark.parametrize(("fine", "most"), [(1.0, 0.7), (2.5, 1.1)])
def test_textures_stay_sharp_while_the_camera_moves(fine: float, most: float) -> None:
    """Texels of 3 to 8 pixels are nearer to the truth than in single samples, those of 1 to 3 pixels as near."""
    texture = checker_quad(4.0)
    texture = replace(texture, uvs=fine * np.asarray(texture.uvs))
    scene = ls.Scene((), [texture], [ls.LightDirectional((0.2, 0.3, 1.0))])
    steps = [
        replace(CAMERA, camera_from_world=similarity((0.1, 1.0, 0.0), 0.004 * n, offset=(0.013 * n, 0.0, 0.0)))
        for n in range(16)
    ]
    shown = [
        [each.render(scene, camera) for camera in steps][-1] for each in (renderer(), renderer(antialiasing=False))
    ]
    good = truth(scene, steps[-1])
    assert error(shown[0], good) < most * error(shown[1], good)


def test_light_that_fades_is_followed() -> None:
    """By a tenth a frame: what is shown lags behind by less than that."""
    smooth = renderer()
    for number in range(30):
        left = 0.9 ** max(number - 10, 0)
        frame = smooth.render(scene_of(shining(left, left, left)), CAMERA)
        assert frame.color[24, 32, 0] == pytest.approx(left, rel=0.1)


def test_another_light_is_seen_at_once() -> None:
    """Even where it is so little different that noise could be."""
    before, after = scene_of(shining(0.8, 0.8, 0.8)), scene_of(shining(0.784, 0.784, 0.784))
    smooth = renderer()
    for _ in range(16):
        smooth.render(before, CAMERA)
    assert smooth.render(after, CAMERA).color[CAMERA.height // 2, CAMERA.width // 2] == pytest.approx(0.784, abs=1e-4)


def test_threads_do_not_matter() -> None:
    """The same bits with 1, 2 and 5, also of a sequence that begins anew."""
    mesh = shining(0.9, 0.6, 0.3, half=0.5, tilt=0.4)
    scenes = [
        ls.Scene(
            [one_gaussian((-0.3, 0.2, 3.0), 0.2, 0.8)],
            [ls.MeshInstance(mesh, similarity(offset=(x, 0.0, 0.0)))],
            [LAMP],
        )
        for x in (0.0, 0.01, 0.03, 0.03)
    ]
    results = []
    for threads in (1, 2, 5):
        smooth = renderer(threads=threads)
        for _ in range(2):
            smooth.reset()
            results.append([smooth.render(scene, CAMERA).color for scene in scenes])
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])
