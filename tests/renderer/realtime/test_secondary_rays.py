"""Secondary rays continue at smooth surfaces: brightness of rooms with glass and mirrors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import PathPrimary
from support.scenes.light_scenes import box, clear_glass, matte, parallelogram
from support.scenes.path_rooms import floor_and_walls

MIRROR = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
EYE = ls.Camera.look_at((1.4, 1.1, 2.4), (0.0, 0.2, 0.0), (0.0, 1.0, 0.0), width=48, height=36, fov_y=0.7)
INSIDE = ls.Camera.look_at((2.1, 1.5, 4.9), (1.95, 1.15, 0.0), (0.1, 1.0, 0.0), width=48, height=36, fov_y=0.8)


def last_frames(scene: ls.Scene, camera: ls.Camera, frames: int = 40) -> np.ndarray:
    """Returns the mean of the last half of a sequence, linear, shape (H, W, 3)."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=8)  # enough for camera rays through two panes
    renderer = ls.create_renderer(config, "cpu")
    found = [renderer.render(scene, camera).color for _ in range(frames)]
    return np.stack(found[frames // 2 :]).astype(np.float64).mean(axis=0)


def paths(scene: ls.Scene, camera: ls.Camera, samples: int) -> ls.Frame:
    """Path-traces the reference."""
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.PATH, samples=samples, max_bounces=32, path=ls.PathConfig(primary=PathPrimary.ISO)
    )
    return ls.render(scene, camera, config, device="cpu")


@pytest.mark.parametrize(
    "material",
    [
        pytest.param(MIRROR, marks=pytest.mark.deep),
        pytest.param(clear_glass(), marks=pytest.mark.deep),
        replace(clear_glass(), metallic=0.5),
    ],
)
def test_mirrors_and_glass_are_invisible_in_a_white_furnace_in_real_time(material: ls.MaterialPbr) -> None:
    """White surfaces, mirrors and clear glass have radiance 1.

    The tolerance of 2 % is the SH error of a step in radiance.
    """
    floor = parallelogram((-3.0, 0.0, -3.0), (0.0, 0.0, 6.0), (6.0, 0.0, 0.0), matte(1.0))
    wall = ls.MeshInstance(box((1.6, 1.2, 0.1), material), position=(0.0, 0.65, -0.3))
    scene = ls.Scene((), [floor, wall], [ls.LightEnvironment(np.ones((8, 16, 3), np.float32))])
    found = last_frames(scene, EYE)
    frame = ls.render(scene, EYE, ls.RenderConfig(), device="cpu")
    near = (frame.instance_index == 0) & (frame.depth < 3.0)
    assert near.sum() > 300
    assert found[near].mean() == pytest.approx(1.0, abs=0.02)


def room_with(*objects: ls.MeshInstance) -> ls.Scene:
    """Returns a closed room with objects in it and a point light, which no ray hits."""
    ceiling = parallelogram((0.0, 3.0, 0.0), (4.0, 0.0, 0.0), (0.0, 0.0, 5.0), matte(0.6))
    behind = parallelogram((4.0, 0.0, 5.0), (-4.0, 0.0, 0.0), (0.0, 3.0, 0.0), matte(0.6))
    return ls.Scene(
        (), [*floor_and_walls(), ceiling, behind, *objects], [ls.LightPoint((2.0, 2.6, 2.5), intensity=9.0)]
    )


PANE = ls.MeshInstance(box((3.6, 2.6, 0.1), clear_glass()), position=(2.0, 1.5, 0.2))
GREEN = replace(clear_glass(), base_color=(0.5, 0.9, 0.6))


@pytest.mark.parametrize(
    "objects",
    [
        pytest.param([PANE], marks=pytest.mark.deep),
        [PANE, ls.MeshInstance(PANE.mesh, position=(2.0, 1.5, 0.5))],
        [ls.MeshInstance(box((3.0, 0.08, 3.5), GREEN), position=(2.0, 1.9, 2.2))],
        pytest.param(
            [ls.MeshInstance(box((0.05, 2.4, 4.0), MIRROR), position=(0.1, 1.4, 2.5))], marks=pytest.mark.deep
        ),
    ],
    ids=["a pane before a wall", "two panes", "a coloured table", "a mirror on a wall"],
)
def test_realtime_room_with_glass_matches_the_path_tracer(objects: list[ls.MeshInstance]) -> None:
    """The mean and each channel are within 4 %; black objects would cost 10 to 50 %."""
    scene = room_with(*objects)
    found, truth = last_frames(scene, INSIDE, 60), paths(scene, INSIDE, 96).color
    ratio = found.mean(axis=(0, 1)) / truth.mean(axis=(0, 1))
    np.testing.assert_allclose(ratio, 1.0, atol=0.04)


def test_sun_that_a_room_blocks_adds_little_noise_to_reflections_in_a_metal() -> None:
    """The sun outside is 30 times as bright as the lamp; the frames' changes grow by less than half."""
    metal = ls.MaterialPbr(roughness=0.3, metallic=1.0)
    room = room_with(ls.MeshInstance(ls.sphere(0.7, material=metal), position=(2.0, 1.2, 2.0)))
    sun = ls.LightDirectional((-0.3, -1.0, -0.2), intensity=60.0)
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.REALTIME,
        aovs=("indirect_glossy",),
        realtime=ls.RealtimeConfig(antialiasing=False),
    )
    noise: list[float] = []
    for lights in (room.lights, [*room.lights, sun]):
        renderer, scene = ls.create_renderer(config, "cpu"), replace(room, lights=lights)
        frames = [renderer.render(scene, INSIDE).indirect_glossy for _ in range(40)]
        late = np.stack([frame for frame in frames if frame is not None])[24:]
        noise.append(float(np.abs(np.diff(late, axis=0)).mean() / late.mean()))
    assert noise[1] < 1.5 * noise[0]


def test_realtime_light_reflected_by_a_mirror_matches_the_path_tracer() -> None:
    """A floor behind a screen is lit by the mirror alone, within 10 % of the path tracer."""
    emissive = replace(matte(0.0), emissive=(6.0, 6.0, 6.0))
    light = ls.MeshInstance(box((1.6, 0.6, 1.8), emissive), position=(1.3, 0.9, 0.0))
    screen = ls.MeshInstance(box((0.05, 2.4, 2.4), matte(0.0)), position=(0.3, 1.2, 0.0))
    mirror = ls.MeshInstance(box((4.0, 0.05, 4.0), MIRROR), position=(0.0, 3.2, 0.0))
    floor = parallelogram((-2.0, 0.0, -1.5), (0.0, 0.0, 3.0), (2.2, 0.0, 0.0), matte(0.6))
    eye = ls.Camera.look_at((-2.5, 2.4, 2.0), (-0.9, 0.0, 0.0), (0.0, 1.0, 0.0), width=48, height=36, fov_y=0.6)
    scene = ls.Scene((), [floor, light, screen, mirror])
    truth = paths(scene, eye, 256)
    on_floor = truth.instance_index == 0
    assert truth.color[on_floor].mean() > 0.03
    found = last_frames(scene, eye)
    assert found[on_floor].mean() == pytest.approx(truth.color[on_floor].mean(), rel=0.1)
