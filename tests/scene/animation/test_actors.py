"""Actors show their subject at its transform at each time, and refuse invalid values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.rig_files import BEND, CARRY, TubeRig
from support.kinds import expect_kind
from support.scenes.raster_scenes import random_gaussians

ROTATION = np.array([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
MOVE = ls.Keyframes([0.0, 2.0], positions=[[0, 0, 0], [0, 4, 0]])


@pytest.fixture
def rig(tmp_path: Path) -> ls.avatars.Rig:
    """Returns a rig with two clips of one and two seconds."""
    return ls.avatars.load_rig(TubeRig(clips={"bend": BEND, "carry": CARRY}).write(tmp_path / "tube.glb"))


def test_pose_of_an_actor_is_its_motion_times_its_placement():
    """An actor's pose is its motion times its placement; without motion, it is the placement."""
    gaussians = random_gaussians(1, count=5)
    actor = ls.Actor(gaussians, MOVE, ROTATION, name="one")
    (instance,) = actor.at(1.0)
    assert expect_kind(ls.SplatInstance, instance).gaussians is gaussians and instance.name == "one"
    np.testing.assert_allclose(instance.transform, MOVE.at(1.0) @ ROTATION)
    (still,) = ls.Actor(gaussians, world_from_object=ROTATION).at(1.0)
    np.testing.assert_array_equal(still.transform, ROTATION)


def test_clip_of_an_actor_repeats_unless_loop_is_off_and_then_holds_its_last_pose(rig: ls.avatars.Rig) -> None:
    """A clip repeats at the actor's speed, or holds its last pose."""
    rigged = ls.bind_gaussians(rig, 300)

    def means(time: float, **settings: object) -> np.ndarray:
        actor = replace(ls.Actor(rigged), **settings)
        return expect_kind(ls.SplatInstance, actor.at(time)[0]).gaussians.means

    np.testing.assert_array_equal(means(0.25), rigged.at(0.25).means)
    np.testing.assert_array_equal(means(2.25), rigged.at(0.25).means)
    np.testing.assert_array_equal(means(2.25, loop=False), rigged.at(1.0).means)
    np.testing.assert_array_equal(means(0.25, speed=2.0), rigged.at(0.5).means)
    np.testing.assert_array_equal(means(0.25, speed=0.0), rigged.at(0.0).means)
    np.testing.assert_array_equal(means(0.25, clip="carry"), rigged.at(0.25, "carry").means)
    assert ls.Actor(rigged, speed=2.0).own_duration == 0.5


def test_actor_turns_meshes_rigs_and_scenes_into_placed_instances(rig: ls.avatars.Rig) -> None:
    """Meshes and rigs become mesh instances, scenes all of their instances, each with its own placement."""
    (posed,) = ls.Actor(rig).at(0.5)
    np.testing.assert_array_equal(expect_kind(ls.MeshInstance, posed).mesh.positions, rig.pose(0.5).positions)
    scene = ls.Scene(splats=[ls.SplatInstance(random_gaussians(1, count=3), ROTATION)], meshes=[rig.mesh])
    splat, mesh = ls.Actor(scene, MOVE).at(2.0)
    np.testing.assert_allclose(splat.transform, MOVE.at(2.0) @ ROTATION)
    assert expect_kind(ls.MeshInstance, mesh).mesh is scene.meshes[0].mesh
    (instance,) = ls.Actor(rig.mesh, MOVE, np.diag([1.0, 2.0, 3.0, 1.0])).at(0.0)
    assert expect_kind(ls.MeshInstance, instance).mesh is rig.mesh


def test_actor_of_a_scene_preserves_the_settings_of_its_captures():
    """Materials, SH degrees and ``shadow_catcher`` are preserved, and so are names unless the actor has one."""
    settings = {"material": ls.MaterialPbr(), "sh_degree": 1, "shadow_catcher": True, "name": "prop"}
    scene = ls.Scene(splats=[ls.SplatInstance(random_gaussians(1, count=3), ROTATION, **settings)])
    (instance,) = ls.Actor(scene, MOVE).at(1.0)
    assert {name: getattr(instance, name) for name in settings} == settings
    assert ls.Actor(scene, name="walker").at(1.0)[0].name == "walker"


def test_frame_times_of_an_animation_are_evenly_spaced(rig: ls.avatars.Rig) -> None:
    """Frame times are evenly spaced, and actors keep their order."""
    gaussians = random_gaussians(1, count=5)
    animation = ls.Animation(ls.Scene(), [ls.Actor(gaussians, MOVE), ls.Actor(rig)], fps=10.0, frame_count=20)
    np.testing.assert_allclose(animation.times, np.arange(20) / 10.0)
    assert animation.duration == 2.0
    first, second = animation.actors_at(1.0)
    np.testing.assert_allclose(first.transform[:3, 3], [0.0, 2.0, 0.0])
    assert isinstance(second, ls.MeshInstance)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"subject": 3}, "an actor is a int, expected Gaussians"),
        ({"motion": ROTATION}, "motion is a ndarray, expected Keyframes"),
        ({"world_from_object": np.diag([1.0, 2.0, 1.0, 1.0])}, "scales the axes by 1, 2 and 1"),
        ({"world_from_object": np.full((4, 4), np.nan)}, "world_from_object has non-finite values"),
        ({"speed": -1.0}, "speed is -1.0, expected a number at least 0"),
        ({"speed": float("nan")}, "speed is nan"),
        ({"loop": "yes"}, "loop is 'yes', expected True or False"),
        ({"casts_shadow": 2}, "casts_shadow is 2"),
        ({"clip": "walk"}, "clip is 'walk', but the actor has no rig"),
    ],
)
def test_actor_refuses_invalid_values_when_it_is_created(settings, problem):
    """Invalid values are refused when the actor is created, not at a frame."""
    with pytest.raises(ls.SceneError, match=problem):
        ls.Actor(**{"subject": random_gaussians(1, count=5), **settings})


def test_actor_refuses_a_clip_that_its_rig_does_not_have(rig: ls.avatars.Rig) -> None:
    """The error lists the rig's clips."""
    with pytest.raises(ls.SceneError, match="no clip 'walk', it has 'bend', 'carry'"):
        ls.Actor(rig, clip="walk")


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ({"scene": None}, "scene is a NoneType, expected a Scene"),
        ({"actors": [3]}, "actors holds a int, expected Actor"),
        ({"fps": 0.0}, "fps is 0.0"),
        ({"frame_count": 0}, "frame_count is 0"),
        ({"frame_count": 2.5}, "frame_count is 2.5"),
        ({"frame_count": 1_000_001}, "frame_count is 1,000,001 at 25 frames a second, expected at most 1,000,000"),
        ({"lighting": 1}, "lighting is 1, expected an AvatarLightingConfig"),
    ],
)
def test_error_for_an_invalid_value_of_an_animation_names_the_setting(settings, problem):
    """The error names the setting in one line."""
    with pytest.raises(ls.SceneError, match=problem):
        ls.Animation(**{"scene": ls.Scene(), **settings})


def test_a_function_of_time_is_an_actor_and_is_called_once_for_each_time():
    """What the function returns is placed; a repeated time takes the last result."""
    times: list[float] = []

    def dance(time: float) -> list[object]:
        times.append(time)
        moved = replace(random_gaussians(1, count=3), means=np.full((3, 3), time))
        return [moved, ls.MeshInstance(ls.box(1.0), ROTATION)]

    actor = ls.Actor(dance, MOVE, speed=2.0)  # pyright: ignore[reportArgumentType]
    splat, mesh = actor.at(0.5)
    assert actor.at(0.5)[0].transform is not None and times == [1.0]
    np.testing.assert_array_equal(expect_kind(ls.SplatInstance, splat).gaussians.means, 1.0)
    np.testing.assert_allclose(mesh.transform, MOVE.at(0.5) @ ROTATION)


def test_a_function_that_returns_something_else_is_refused_with_its_time():
    """The message names the type and the time."""
    with pytest.raises(ls.SceneError, match=r"returned a NoneType at 0\.5 s, expected Gaussians"):
        ls.Actor(lambda time: None).at(0.5)  # pyright: ignore[reportArgumentType]
