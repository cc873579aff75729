"""Frames of `Pipeline.REALTIME` against the path tracer and closed forms, and properties of sequences."""

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
TILE = 12


def sequence(
    scene: ls.Scene, frames: int, camera: ls.Camera = VIEW, *, threads: int | None = None, **settings: Any
) -> tuple[ls.Renderer, ls.Frame]:
    """Returns a renderer, and the last of ``frames`` frames of a static scene."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, **settings), "cpu", threads=threads)
    return renderer, frame_after(renderer, scene, frames, camera)


def frame_after(renderer: ls.Renderer, scene: ls.Scene, frames: int, camera: ls.Camera = VIEW) -> ls.Frame:
    """Returns the last of ``frames`` further frames."""
    frame = renderer.render(scene, camera)
    for _ in range(frames - 1):
        frame = renderer.render(scene, camera)
    return frame


def blocks(image: np.ndarray) -> np.ndarray:
    """Returns means over square blocks of pixels, and over channels."""
    height, width = image.shape[:2]
    return image.reshape(height // TILE, TILE, width // TILE, TILE, 3).mean(axis=(1, 3, 4))


def paths(scene: ls.Scene, samples: int, camera: ls.Camera = VIEW, **settings: Any) -> ls.Frame:
    """Path-traces the reference, with the same first surfaces as the real-time frame."""
    first = ls.PathConfig(primary="iso")  # pyright: ignore[reportArgumentType]
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=samples, path=first, aovs=PARTS, **settings)
    return ls.render(scene, camera, config, device="cpu")


@pytest.mark.parametrize(
    "of_gaussians", [pytest.param(False, id="meshes"), pytest.param(True, id="gaussians", marks=pytest.mark.deep)]
)
def test_realtime_room_matches_the_path_tracer(of_gaussians: bool) -> None:
    """After 64 frames, mean direct light is within 3 % and indirect light within 5 %; with Gaussians, twice as much."""
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


def test_white_box_is_invisible_in_a_white_furnace_in_real_time() -> None:
    """With direct light only, every pixel is 1 up to the noise of samples."""
    environment = ls.LightEnvironment(np.ones((16, 32, 3), np.float32))
    view = ls.Camera.look_at((2.0, 1.5, -2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=96, height=72, fov_y=0.7)
    _, frame = sequence(ls.Scene((), [box((1.0, 1.0, 1.0), matte(1.0))], [environment]), 32, view)
    assert frame.color.mean() == pytest.approx(1.0, abs=0.002)
    assert np.abs(frame.color - 1.0).max() < 0.03


def test_direct_indirect_and_emission_layers_sum_to_the_realtime_frame() -> None:
    """The layers are direct and indirect diffuse and glossy light, and emission."""
    _, frame = sequence(ROOM, 3, aovs=PARTS)
    total = sum(np.asarray(getattr(frame, part), np.float64) for part in PARTS)
    np.testing.assert_allclose(total, frame.color, atol=1e-5, rtol=1e-5)


def test_realtime_frames_do_not_depend_on_thread_count() -> None:
    """The bits are equal with 1, 2 and 5 threads."""
    scene = with_gaussians(PathRoom(ROOM, VIEW), 2000).scene
    one, two, five = (sequence(scene, 3, threads=threads)[1].color for threads in (1, 2, 5))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, five)


@pytest.mark.parametrize("launcher", [partial(Launcher, "cpu", parallel=True), GraphLauncher], ids=["cuda", "graph"])
def test_cpu_and_cuda_schedules_give_equal_realtime_frames(launcher: Callable[[], Launcher]) -> None:
    """CUDA's schedule runs on the CPU, with and without graphs, and agrees up to rounding, whatever the image sizes."""
    scene, settings = with_gaussians(PathRoom(ROOM, VIEW), 2000).scene, ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
    direct, other = ls.create_renderer(settings, "cpu"), ls.Renderer(settings, launcher())
    small = room_camera(64, 48)
    for camera in (*[VIEW] * 5, small, VIEW, *[small] * 3, VIEW, VIEW):
        error = np.abs(other.render(scene, camera).color - direct.render(scene, camera).color).max(axis=2)
        assert error.mean() < 1e-4
        assert (error > 1e-3).mean() < 0.01


def test_realtime_frames_after_a_reset_equal_those_of_a_new_renderer() -> None:
    """The bits are equal, whatever was rendered before."""
    renderer, first = sequence(ROOM, 3)
    frame_after(renderer, ls.Scene((), ROOM.meshes[:4]), 2)
    renderer.reset()
    np.testing.assert_array_equal(frame_after(renderer, ROOM, 3).color, first.color)


@pytest.mark.parametrize(
    "size", [pytest.param((64, 48), marks=pytest.mark.deep), (142, 108)], ids=["smaller", "larger"]
)
def test_sequence_continues_when_the_image_size_changes(size: tuple[int, int]) -> None:
    """The first frame of another size has less than three quarters of the error of a new renderer's first frame."""
    camera = room_camera(*size)
    renderer, _ = sequence(ROOM, 24)
    first, new = frame_after(renderer, ROOM, 1, camera).color, sequence(ROOM, 1, camera)[1].color
    settled = sequence(ROOM, 24, camera)[1].color
    error, error_new = (np.sqrt(np.mean(np.square(image - settled))) for image in (first, new))
    assert error < 0.75 * error_new
    renderer.reset()
    np.testing.assert_array_equal(frame_after(renderer, ROOM, 1, camera).color, new)


def test_light_that_a_capture_casts_in_real_time_includes_all_bounces() -> None:
    """A captured ball lights a dark room within 1.5 % of the path tracer; bounces are 3 % of the light."""
    dark = [instance for instance in ROOM.meshes if not instance.mesh.material.is_emissive]
    *walls, ball, tall = (replace(each, mesh=replace(each.mesh, material=matte(0.5))) for each in dark)
    captured = as_splats(replace(ball.mesh, material=matte(0.9)), 4000)
    scene = ls.Scene([replace(captured, world_from_object=ball.transform, material=None)], [*walls, tall])
    camera = room_camera(48, 36)
    truth = paths(scene, 32, camera, lighting=True, max_bounces=16)
    _, frame = sequence(scene, 24, camera, lighting=True)
    lit = frame.instance_index > 0
    assert frame.color[lit].mean() == pytest.approx(truth.color[lit].mean(), rel=0.015)


def test_realtime_direct_and_indirect_light_fade_when_a_light_goes_out() -> None:
    """Nine tenths of the direct light are gone in 8 frames, of the indirect light in 24."""
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


def test_realtime_shadow_of_a_moved_object_moves_with_the_object() -> None:
    """After 24 frames, the former shadow is within 5 % of a sequence without the object; no pixel was ever black."""
    light = ls.LightPoint((2.0, 2.8, 2.5), intensity=20.0)
    floor = [instance for instance in ROOM.meshes if not instance.mesh.material.is_emissive][:4]
    ball = ROOM.meshes[-2]
    scenes = [
        ls.Scene((), [*floor, replace(ball, world_from_object=moved(x) @ ball.transform)], [light]) for x in (0.0, 1.5)
    ]
    renderer, _ = sequence(scenes[0], 24)
    first = frame_after(renderer, scenes[1], 1)
    later = frame_after(renderer, scenes[1], 23)
    steady = sequence(scenes[1], 48)[1]
    assert first.color[first.alpha > 0.0].mean(axis=-1).min() > 0.0
    errors = blocks(later.color) / blocks(steady.color) - 1.0
    assert np.percentile(np.abs(errors), 95) < 0.05


def moved(x: float) -> np.ndarray:
    """Returns a translation along x."""
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_realtime_mirror_shows_indirectly_lit_surfaces_as_bright_as_the_path_tracer() -> None:
    """The mean brightness of the mirror is within 15 % of the path tracer."""
    silver = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    shade = box((0.8, 0.8, 0.8), silver)
    placed = ls.MeshInstance(shade, position=(2.6, 0.6, 1.6))
    scene = replace(ROOM, meshes=(*ROOM.meshes[:-2], placed))
    _, frame = sequence(scene, 16, aovs=PARTS)
    truth = paths(scene, 16)
    on_mirror = frame.instance_index == len(scene.meshes) - 1
    assert on_mirror.sum() > 100
    assert frame.color[on_mirror].mean() == pytest.approx(truth.color[on_mirror].mean(), rel=0.15)


def test_realtime_and_hybrid_pipelines_darken_shadow_catchers_equally() -> None:
    """Only shadows are applied to the catchers."""
    floor = with_gaussians(PathRoom(ROOM, VIEW), 3000).scene.splats[0]
    receiver = replace(floor, shadow_catcher=True, material=ls.MaterialSimple(ambient=0.0))
    ball, light = ROOM.meshes[-2], ls.LightPoint((2.0, 1.5, 4.5), intensity=10.0)
    scene = ls.Scene([receiver], [ball], [light])
    _, frame = sequence(scene, 2, realtime=ls.RealtimeConfig(antialiasing=False))  # samples at pixel centres
    hybrid = ls.render(scene, VIEW, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID), device="cpu")
    captured = frame.instance_index == 0
    np.testing.assert_allclose(frame.color[captured], hybrid.color[captured], atol=0.02)
    assert (hybrid.color[captured] < 0.9 * frame_without(scene).color[captured]).any()


def frame_without(scene: ls.Scene) -> ls.Frame:
    """Renders the scene without shadow casters."""
    return ls.render(replace(scene, meshes=()), VIEW, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID), device="cpu")


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"samples": 4}, "one sample"), ({"noise": 0.1}, "one sample"), ({"aovs": "bounces"}, "no bounces")],
)
def test_settings_unsupported_by_the_realtime_pipeline_are_refused(settings: dict[str, Any], message: str) -> None:
    """The error states in one line what the pipeline does not support."""
    with pytest.raises(ls.ConfigError, match=message):
        sequence(ROOM, 1, **settings)


def test_realtime_frames_cannot_be_resumed() -> None:
    """The error says that the next frame continues the sequence."""
    renderer, frame = sequence(ROOM, 1)
    with pytest.raises(ls.ConfigError, match="next frame"):
        renderer.render(ROOM, VIEW, resume=frame)


def test_memory_of_a_realtime_renderer_stays_constant_while_the_camera_walks() -> None:
    """The memory does not grow from frame to frame."""
    renderer, _ = sequence(ROOM, 1)
    sizes: list[int] = []
    for step in range(40):
        view = replace(VIEW, camera_from_world=VIEW.camera_from_world @ moved(0.02 * np.sin(step)))
        stats = renderer.render(ROOM, view).stats
        assert stats is not None
        sizes.append(stats.memory_bytes)
    assert sizes[-1] == sizes[10]


def test_realtime_light_has_equal_means_if_sampled_every_frame_or_every_second_frame() -> None:
    """With half of the samples a frame, the mean after 64 frames is equal, and disoccluded pixels are not black."""
    settings = ls.RealtimeConfig(light_interval=2)
    truth = sequence(ROOM, 64, max_bounces=0)[1].color
    renderer, frame = sequence(ROOM, 64, max_bounces=0, realtime=settings)
    assert frame.color.mean() == pytest.approx(truth.mean(), rel=0.01)
    np.testing.assert_allclose(blocks(frame.color), blocks(truth), rtol=0.1, atol=0.02 * truth.mean())
    aside = ls.Camera.look_at((2.6, 1.5, 4.9), (2.45, 1.15, 0.0), (0.1, 1.0, 0.0), width=96, height=72, fov_y=0.8)
    uncovered = frame_after(renderer, ROOM, 1, aside).color.max(axis=2)
    lit = sequence(ROOM, 64, aside, max_bounces=0)[1].color.max(axis=2)
    assert uncovered[lit > 0.1 * lit.mean()].min() > 0.0


def test_realtime_brightness_is_right_again_after_all_lights_were_removed() -> None:
    """Disabled lights light nothing; without any lights, meshes get the default headlight, as in other pipelines."""
    plain = ls.Scene((), [box((1.0, 1.0, 1.0), matte(0.7))])
    light = ls.LightPoint((1.0, 2.0, -2.0), intensity=8.0)
    view = ls.Camera.look_at((2.0, 1.5, -2.5), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), width=48, height=36, fov_y=0.7)
    settings: dict[str, Any] = {"lighting": None, "max_bounces": 0}
    lit, off = replace(plain, lights=(light,)), replace(plain, lights=(replace(light, enabled=False),))
    renderer, before = sequence(lit, 8, view, **settings)
    assert before.color.max() > 0.1
    dark = frame_after(renderer, off, 8, view)
    assert dark.color.max() < 0.01 * before.color.max()
    for scene in (plain, lit):
        expected = sequence(scene, 1, view, **settings)[1].color.mean()
        for frames in (1, 31):
            assert frame_after(renderer, scene, frames, view).color.mean() == pytest.approx(expected, rel=0.05)


def test_realtime_renderer_refuses_transforms_with_nan() -> None:
    """The error is raised before rendering, in one line."""
    bad = np.eye(4)
    bad[0, 3] = np.nan
    with pytest.raises(ls.SceneError, match="world_from_object has non-finite values") as error:
        replace(ROOM.meshes[0], world_from_object=bad)
    assert "\n" not in str(error.value)
