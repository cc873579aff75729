"""Frames of `Pipeline.REALTIME`: held to paths, to closed forms, and to what a sequence promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.runtime.launcher import Launcher
from support.compare.graph_launcher import GraphLauncher
from support.scenes.light_scenes import box, matte
from support.scenes.path_rooms import PathRoom, path_rooms, room_camera, with_gaussians
from support.scenes.path_scenes import as_splats

PARTS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy", "emission")
VIEW = room_camera(96, 72)
ROOM = path_rooms()["diffuse_area"].scene
BLOCK = 12


def sequence(
    scene: ls.Scene, frames: int, camera: ls.Camera = VIEW, *, threads: int | None = None, **settings: Any
) -> tuple[ls.Renderer, ls.Frame]:
    """A renderer, and the last of so many frames of a scene that stands still."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, **settings), "cpu", threads=threads)
    return renderer, frame_after(renderer, scene, frames, camera)


def frame_after(renderer: ls.Renderer, scene: ls.Scene, frames: int, camera: ls.Camera = VIEW) -> ls.Frame:
    """The last of so many further frames."""
    frame = renderer.render(scene, camera)
    for _ in range(frames - 1):
        frame = renderer.render(scene, camera)
    return frame


def blocks(image: np.ndarray) -> np.ndarray:
    """Means over square blocks of pixels, and over channels."""
    height, width = image.shape[:2]
    return image.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean(axis=(1, 3, 4))


def paths(scene: ls.Scene, samples: int, camera: ls.Camera = VIEW, **settings: Any) -> ls.Frame:
    """The truth, of the same first surface."""
    first = ls.PathConfig(primary="iso")  # pyright: ignore[reportArgumentType]
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, path=first, aovs=PARTS, **settings)
    return ls.render(scene, camera, config, device="cpu")


@pytest.mark.parametrize(
    "of_gaussians", [pytest.param(False, id="meshes"), pytest.param(True, id="gaussians", marks=pytest.mark.deep)]
)
def test_a_room_is_lit_as_by_paths(of_gaussians: bool) -> None:
    """After 64 frames: direct light within 3 % in the mean, indirect light 5 %, twice that with Gaussians."""
    scene = with_gaussians(PathRoom(ROOM, VIEW), 4000).scene if of_gaussians else ROOM
    truth = paths(scene, 48)
    _, frame = sequence(scene, 64, aovs=PARTS)
    assert frame.direct_diffuse is not None
    assert truth.direct_diffuse is not None
    assert frame.indirect_diffuse is not None
    assert truth.indirect_diffuse is not None
    off = 2.0 if of_gaussians else 1.0
    assert frame.direct_diffuse.mean() == pytest.approx(truth.direct_diffuse.mean(), rel=0.03 * off)
    assert frame.indirect_diffuse.mean() == pytest.approx(truth.indirect_diffuse.mean(), rel=0.05 * off)
    errors = blocks(frame.color) / blocks(truth.color) - 1.0
    assert np.percentile(np.abs(errors), 90) < 0.10


def test_a_white_box_under_a_white_sky_cannot_be_seen() -> None:
    """Nothing but direct light: every pixel is 1, but for what the noise of samples leaves."""
    sky = ls.LightEnvironment(np.ones((16, 32, 3), np.float32))
    view = ls.Camera.look_at((2.0, 1.5, -2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=96, height=72, fov_y=0.7)
    _, frame = sequence(ls.Scene((), [box((1.0, 1.0, 1.0), matte(1.0))], [sky]), 32, view)
    assert frame.color.mean() == pytest.approx(1.0, abs=0.002)
    assert np.abs(frame.color - 1.0).max() < 0.03


def test_layers_are_the_frame() -> None:
    """Direct and indirect, diffuse and glossy light, and what shines, add up to it."""
    _, frame = sequence(ROOM, 3, aovs=PARTS)
    total = sum(np.asarray(getattr(frame, part), np.float64) for part in PARTS)
    np.testing.assert_allclose(total, frame.color, atol=1e-5, rtol=1e-5)


def test_threads_do_not_matter() -> None:
    """The same bits with 1, 2 and 5."""
    scene = with_gaussians(PathRoom(ROOM, VIEW), 2000).scene
    one, two, five = (sequence(scene, 3, threads=threads)[1].color for threads in (1, 2, 5))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, five)


@pytest.mark.parametrize("launcher", [partial(Launcher, "cpu", parallel=True), GraphLauncher], ids=["cuda", "graph"])
def test_schedules_do_not_matter(launcher: Callable[[], Launcher]) -> None:
    """Frame by frame the same with the kernels of CUDA, replayed as graphs or not, but for what rounding does."""
    scene, settings = with_gaussians(PathRoom(ROOM, VIEW), 2000).scene, ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
    direct, other = ls.create_renderer(settings, "cpu"), ls.Renderer(settings, launcher())
    for _ in range(5):
        error = np.abs(other.render(scene, VIEW).color - direct.render(scene, VIEW).color).max(axis=2)
        assert error.mean() < 1e-4
        assert (error > 1e-3).mean() < 0.01


def test_reset_is_a_new_renderer() -> None:
    """Bit for bit, whatever was rendered before."""
    renderer, first = sequence(ROOM, 3)
    frame_after(renderer, ls.Scene((), ROOM.meshes[:4]), 2)
    renderer.reset()
    np.testing.assert_array_equal(frame_after(renderer, ROOM, 3).color, first.color)


def test_another_size_begins_anew(caplog: pytest.LogCaptureFixture) -> None:
    """As a new renderer does; one line says so, once, unless the sequence was to end."""
    small = room_camera(64, 48)
    renderer, _ = sequence(ROOM, 2)
    again = frame_after(renderer, ROOM, 12, small)
    frame_after(renderer, ROOM, 1)
    told = [line for line in caplog.messages if "size" in line]
    assert told == ["the image size has changed from 96 x 72 to 64 x 48: the real-time history is discarded"]
    other, _ = sequence(ROOM, 1, max_bounces=0)
    other.reset()
    frame_after(other, ROOM, 1, small)
    assert len([line for line in caplog.messages if "size" in line]) == 1
    assert np.isfinite(again.color).all()
    assert again.color.mean() == pytest.approx(sequence(ROOM, 12, small)[1].color.mean(), rel=0.02)


def test_captures_that_shine_light_rooms_by_all_bounces() -> None:
    """A ball that keeps its look lights a dark room as by paths, to 1.5 %; without its bounces 3 % are missing."""
    dark = [instance for instance in ROOM.meshes if not instance.mesh.material.is_emissive]
    *walls, ball, tall = (replace(each, mesh=replace(each.mesh, material=matte(0.5))) for each in dark)
    shining = as_splats(replace(ball.mesh, material=matte(0.9)), 4000)
    scene = ls.Scene([replace(shining, world_from_object=ball.transform, material=None)], [*walls, tall])
    camera = room_camera(48, 36)
    truth = paths(scene, 32, camera, lighting=True, max_bounces=16)
    _, frame = sequence(scene, 24, camera, lighting=True)
    lit = frame.instance_index > 0
    assert frame.color[lit].mean() == pytest.approx(truth.color[lit].mean(), rel=0.015)


def test_a_lamp_that_goes_out_is_gone() -> None:
    """Its direct light by nine tenths in eight frames, its indirect light in 24."""
    dark = [instance for instance in ROOM.meshes if not instance.mesh.material.is_emissive]
    lit, out = (ls.Scene((), dark, [ls.LightPoint((2.0, 2.5, 2.5), intensity=power)]) for power in (10.0, 0.0))
    renderer, before = sequence(lit, 32, aovs=PARTS)
    assert before.direct_diffuse is not None
    assert before.indirect_diffuse is not None
    soon = frame_after(renderer, out, 8)
    assert soon.direct_diffuse is not None
    assert soon.direct_diffuse.mean() < 0.1 * before.direct_diffuse.mean()
    late = frame_after(renderer, out, 16)
    assert late.indirect_diffuse is not None
    assert late.indirect_diffuse.mean() < 0.1 * before.indirect_diffuse.mean()


def test_a_ball_that_moves_takes_its_shadow_along() -> None:
    """Where its shadow was is as bright after 24 frames as if it had never been there, to 5 %; nothing is black."""
    lamp = ls.LightPoint((2.0, 2.8, 2.5), intensity=20.0)
    floor = [instance for instance in ROOM.meshes if not instance.mesh.material.is_emissive][:4]
    ball = ROOM.meshes[-2]
    scenes = [
        ls.Scene((), [*floor, replace(ball, world_from_object=moved(x) @ ball.transform)], [lamp]) for x in (0.0, 1.5)
    ]
    renderer, _ = sequence(scenes[0], 24)
    first = frame_after(renderer, scenes[1], 1)
    later = frame_after(renderer, scenes[1], 23)
    steady = sequence(scenes[1], 48)[1]
    assert first.color[first.alpha > 0.0].mean(axis=-1).min() > 0.0
    errors = blocks(later.color) / blocks(steady.color) - 1.0
    assert np.percentile(np.abs(errors), 95) < 0.05


def moved(x: float) -> np.ndarray:
    """A translation."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_a_mirror_shows_indirect_light() -> None:
    """What direct light does not reach is not black in it."""
    silver = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    shade = box((0.8, 0.8, 0.8), silver)
    placed = ls.MeshInstance(shade, position=(2.6, 0.6, 1.6))
    scene = replace(ROOM, meshes=(*ROOM.meshes[:-2], placed))
    _, frame = sequence(scene, 16, aovs=PARTS)
    truth = paths(scene, 16)
    on_mirror = frame.instance_index == len(scene.meshes) - 1
    assert on_mirror.sum() > 100
    assert frame.color[on_mirror].mean() == pytest.approx(truth.color[on_mirror].mean(), rel=0.15)


def test_shadow_catchers_are_darkened_as_in_hybrid_frames() -> None:
    """Nothing but shadows falls on them."""
    floor = with_gaussians(PathRoom(ROOM, VIEW), 3000).scene.splats[0]
    receiver = replace(floor, shadow_catcher=True, material=ls.MaterialSimple(ambient=0.0))
    ball, lamp = ROOM.meshes[-2], ls.LightPoint((2.0, 1.5, 4.5), intensity=10.0)
    scene = ls.Scene([receiver], [ball], [lamp])
    _, frame = sequence(scene, 2, realtime=ls.RealtimeConfig(antialiasing=False))  # in the middles of pixels
    hybrid = ls.render(scene, VIEW, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID), device="cpu")
    captured = frame.instance_index == 0
    np.testing.assert_allclose(frame.color[captured], hybrid.color[captured], atol=0.02)
    assert (hybrid.color[captured] < 0.9 * frame_without(scene).color[captured]).any()


def frame_without(scene: ls.Scene) -> ls.Frame:
    """Without what casts shadows."""
    return ls.render(replace(scene, meshes=()), VIEW, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID), device="cpu")


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"samples": 4}, "one sample"), ({"noise": 0.1}, "one sample"), ({"aovs": "bounces"}, "no bounces")],
)
def test_what_sequences_do_not_have_is_said(settings: dict[str, Any], said: str) -> None:
    """In one line."""
    with pytest.raises(ls.ConfigError, match=said):
        sequence(ROOM, 1, **settings)


def test_a_frame_of_a_sequence_is_not_resumed() -> None:
    """The next one goes on."""
    renderer, frame = sequence(ROOM, 1)
    with pytest.raises(ls.ConfigError, match="next frame"):
        renderer.render(ROOM, VIEW, resume=frame)


def test_a_long_walk_holds_its_memory() -> None:
    """Nothing grows from frame to frame."""
    renderer, _ = sequence(ROOM, 1)
    sizes: list[int] = []
    for step in range(40):
        view = replace(VIEW, camera_from_world=VIEW.camera_from_world @ moved(0.02 * np.sin(step)))
        stats = renderer.render(ROOM, view).stats
        assert stats is not None
        sizes.append(stats.memory_bytes)
    assert sizes[-1] == sizes[10]


def test_light_in_every_second_frame_has_the_same_mean() -> None:
    """After 64 frames with half of the samples in each; what a camera uncovers then is not black."""
    settings = ls.RealtimeConfig(light_interval=2)
    truth = sequence(ROOM, 64, max_bounces=0)[1].color
    renderer, frame = sequence(ROOM, 64, max_bounces=0, realtime=settings)
    assert frame.color.mean() == pytest.approx(truth.mean(), rel=0.01)
    np.testing.assert_allclose(blocks(frame.color), blocks(truth), rtol=0.1, atol=0.02 * truth.mean())
    aside = ls.Camera.look_at((2.6, 1.5, 4.9), (2.45, 1.15, 0.0), (0.1, 1.0, 0.0), width=96, height=72, fov_y=0.8)
    uncovered = frame_after(renderer, ROOM, 1, aside).color.max(axis=2)
    lit = sequence(ROOM, 64, aside, max_bounces=0)[1].color.max(axis=2)
    assert uncovered[lit > 0.1 * lit.mean()].min() > 0.0


def test_lights_may_all_go_and_come_back() -> None:
    """Lamps that are off light nothing; meshes without any lamp have the headlight that other pipelines give them."""
    plain = ls.Scene((), [box((1.0, 1.0, 1.0), matte(0.7))])
    lamp = ls.LightPoint((1.0, 2.0, -2.0), intensity=8.0)
    view = ls.Camera.look_at((2.0, 1.5, -2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=48, height=36, fov_y=0.7)
    settings: dict[str, Any] = {"lighting": None, "max_bounces": 0}
    lit, off = replace(plain, lights=(lamp,)), replace(plain, lights=(replace(lamp, enabled=False),))
    renderer, before = sequence(lit, 8, view, **settings)
    assert before.color.max() > 0.1
    dark = frame_after(renderer, off, 8, view)
    assert dark.color.max() < 0.01 * before.color.max()
    for scene in (plain, lit):
        expected = sequence(scene, 1, view, **settings)[1].color.mean()
        for frames in (1, 31):
            assert frame_after(renderer, scene, frames, view).color.mean() == pytest.approx(expected, rel=0.05)


def test_transforms_of_nan_are_refused() -> None:
    """Before a frame is made of them, in one line."""
    bad = np.eye(4)
    bad[0, 3] = np.nan
    with pytest.raises(ls.SceneError, match="world_from_object has non-finite values") as error:
        replace(ROOM.meshes[0], world_from_object=bad)
    assert "\n" not in str(error.value)
