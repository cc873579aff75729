"""Real-time frames with more lights than a surface chooses among, and with lights in any order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.renderer.realtime import light_grid
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import Light
from support.compare.graph_launcher import GraphLauncher
from support.scenes.light_rig import above, floor, floor_points, tile_means, towards
from support.scenes.path_rooms import PathRoom, path_rooms, room_camera, with_gaussians
from support.scenes.path_scenes import diffuse

VIEW = room_camera(48, 36)
ROOM = with_gaussians(PathRoom(path_rooms()["metal_area"].scene, VIEW), 500).scene
"""A room with an emissive mesh, Gaussians and rough metal."""


def point_lights(count: int, size: float = 3.0) -> list[Light]:
    """Returns coloured point lights in a box, without range, whose total power does not depend on their number."""
    rng = np.random.default_rng(0)
    positions, colors = rng.uniform(0.4, size, (count, 3)), rng.uniform(0.05, 1.0, (count, 3))
    return [
        ls.LightPoint(tuple(position), tuple(color), intensity=40.0 / count)
        for position, color in zip(positions.tolist(), colors.tolist(), strict=True)
    ]


def mixed(count: int) -> list[Light]:
    """Returns point lights, a spot, a rectangle, a sun and an environment."""
    return [
        *point_lights(count - 4),
        ls.LightSpot((2.0, 2.5, 2.0), (0.0, -1.0, -0.3), intensity=5.0, radius=0.1),
        ls.LightRect((1.0, 2.5, 2.0), (0.4, 0.0, 0.0), (0.0, 0.0, 0.4), intensity=5.0),
        ls.LightDirectional((0.2, -1.0, -0.3), intensity=0.3, angle=0.01),
        ls.LightEnvironment(np.ones((4, 8, 3), np.float32), intensity=0.2),
    ]


def sequence(
    lights: Sequence[Light], frames: int = 2, *, threads: int | None = None, scene: ls.Scene = ROOM, **settings: Any
) -> np.ndarray:
    """Returns the last frame of a sequence, linear."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, **settings), "cpu", threads=threads)
    return frame_after(renderer, replace(scene, lights=lights), frames)


def frame_after(renderer: ls.Renderer, scene: ls.Scene, frames: int, view: ls.Camera = VIEW) -> np.ndarray:
    """Returns the last of ``frames`` further frames, linear."""
    for _ in range(frames - 1):
        renderer.render(scene, view)
    return np.array(renderer.render(scene, view).color)


@pytest.mark.parametrize("count", [6, 40])
def test_realtime_frames_do_not_depend_on_the_order_of_lights(count: int) -> None:
    """The bits are equal with and without the light grid, also with equal and with disabled lights."""
    lights = mixed(count)
    lights += [lights[0], ls.LightPoint((1.0, 1.0, 1.0), enabled=False)]
    order = np.random.default_rng(1).permutation(len(lights))
    np.testing.assert_array_equal(sequence([lights[i] for i in order]), sequence(lights))


def test_realtime_frames_with_many_lights_do_not_depend_on_thread_count() -> None:
    """The bits are equal with 1, 2 and 5 threads."""
    one, two, five = (sequence(mixed(40), threads=threads) for threads in (1, 2, 5))
    np.testing.assert_array_equal(one, two)
    np.testing.assert_array_equal(one, five)


@pytest.mark.parametrize("launcher", [partial(Launcher, "cpu", parallel=True), GraphLauncher], ids=["cuda", "graph"])
def test_cpu_and_cuda_schedules_give_equal_realtime_frames_with_many_lights(launcher: Any) -> None:
    """CUDA's schedules run on the CPU and differ by rounding only."""
    room = with_gaussians(PathRoom(path_rooms()["diffuse_area"].scene, VIEW), 500).scene
    settings, scene = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), replace(room, lights=mixed(40))
    direct, other = ls.create_renderer(settings, "cpu"), ls.Renderer(settings, launcher())
    for _ in range(3):
        error = np.abs(other.render(scene, VIEW).color - direct.render(scene, VIEW).color).max(axis=2)
        assert error.mean() < 1e-3
        assert (error > 1e-3).mean() < 0.01


def lit_floor(count: int, frames: int, **settings: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns block means of a floor's irradiance under ``count`` lights: rendered, and in closed form."""
    rng = np.random.default_rng(2)
    positions, colors = rng.uniform((-3, 0.4, -3), (3, 2.5, 3), (count, 3)), rng.uniform(0.05, 1.0, (count, 3))
    lights = [
        ls.LightPoint(tuple(position), tuple(color), intensity=50.0 / count)
        for position, color in zip(positions.tolist(), colors.tolist(), strict=True)
    ]
    view, truth = above(width=64, rows=48), np.zeros((48, 64, 3))
    for light in lights:
        direction, distance = towards(light.position, floor_points(view))
        truth += (direction[..., 1] / distance**2)[..., None] * np.multiply(light.color, light.intensity)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, **settings)
    renderer, scene = ls.create_renderer(config, "cpu"), ls.Scene((), [floor(diffuse(0.5))], lights)
    found = np.asarray(frame_after(renderer, scene, frames, view), np.float64) * np.pi / 0.5
    return blocks_of(found), blocks_of(truth)


def blocks_of(image: np.ndarray) -> np.ndarray:
    """Returns means over square blocks of pixels, by channel."""
    return np.stack([tile_means(image[..., channel]) for channel in range(3)], axis=-1)


@pytest.mark.parametrize("interval", [1, pytest.param(2, marks=pytest.mark.deep)])
def test_realtime_floor_under_1000_lights_matches_the_closed_form(interval: int) -> None:
    """After 32 samples a pixel, the mean is within 1 %, and blocks of 8 x 8 pixels are within noise."""
    found, truth = lit_floor(1000, 32 * interval, realtime=ls.RealtimeConfig(light_interval=interval))
    errors = found / truth - 1.0
    assert abs(found.mean() / truth.mean() - 1.0) < 0.01
    assert abs(errors.mean()) < 0.01
    assert np.percentile(np.abs(errors), 90) < 0.10


def test_surfaces_for_which_the_light_grid_has_no_cells_left_are_lit_without_bias(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If there are too many cells, only the first cells get lights; surfaces in the others choose among all lights."""
    for cells_max in (0, 20):
        monkeypatch.setattr(light_grid, "GRID_CELLS_MAX", cells_max)
        found, truth = lit_floor(1000, 32)
        assert abs(found.mean() / truth.mean() - 1.0) < 0.01
        assert np.percentile(np.abs(found / truth - 1.0), 90) < 0.10


def test_reflected_surfaces_for_which_the_light_grid_has_no_cells_left_are_lit_without_bias(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Surfaces beyond the limit use one light a frame instead of all lights of a cell; the mean is equal."""
    mirror = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    ceiling = ls.MeshInstance(floor(mirror), position=(0.0, 4.0, 0.0))
    scene = ls.Scene((), [floor(diffuse(0.5)), ceiling], point_lights(100))
    up = ls.Camera.look_at((0.5, 0.3, 0.5), (1.0, 4.0, 1.0), width=48, height=32, fov_y=0.6)
    settings = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, realtime=ls.RealtimeConfig(antialiasing=False))

    def shown() -> float:
        renderer = ls.create_renderer(settings, "cpu")
        return float(np.mean([frame_after(renderer, scene, 1, up).mean() for _ in range(24)]))

    expected = shown()
    monkeypatch.setattr(light_grid, "GRID_CELLS_MAX", 0)
    assert expected > 0.01
    assert shown() == pytest.approx(expected, rel=0.02)


def test_realtime_brightness_is_right_again_after_200_lights_were_removed() -> None:
    """In between, the default headlight lights the scene; the frame recovers once light has bounced."""
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, lighting=True), "cpu")
    scene = ls.Scene(ROOM.splats, [i for i in ROOM.meshes if not i.mesh.material.is_emissive], point_lights(200))
    means: list[float] = []
    for lights, frames in ((scene.lights, 24), ((), 3), (scene.lights, 8)):
        means.append(float(frame_after(renderer, replace(scene, lights=lights), frames).mean()))
    assert means[0] > 0.05
    assert means[2] == pytest.approx(means[0], rel=0.1)


def test_realtime_frame_of_many_lights_without_objects_is_black() -> None:
    """The scene has lights and no objects."""
    assert not sequence(point_lights(100), scene=ls.Scene()).any()
