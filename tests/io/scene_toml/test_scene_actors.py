"""Actors and animations of scene files: subjects, times, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.rig_files import BEND, CARRY, TubeRig
from support.files.scene_files import load_scene, refuses, write_scene
from support.kinds import expect_kind, present
from support.scenes.raster_scenes import random_gaussians

ACTOR = '[[actors]]\npath = "tube.glb"\ncount = 300\n'
FRAMES = '[[actors]]\npath = "frames"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes a rig, a capture, a mesh and a folder of frames."""
    TubeRig(clips={"bend": BEND, "carry": CARRY}).write(tmp_path / "tube.glb")
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=10))
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "frames").mkdir()
    for k in range(3):
        ls.save(tmp_path / "frames" / f"{k}.ply", random_gaussians(k, count=4 + k))
    return tmp_path


def load_text(folder: Path, text: str) -> ls.Animation:
    """Loads the animation that ``text`` describes."""
    return ls.load_animation(write_scene(folder, text))


def test_every_key_of_a_scene_file_actor_is_read(folder: Path) -> None:
    """Keys set placement, keyframes, clip and flags; the scene has only the static entries."""
    animation = load_text(
        folder,
        '[[splats]]\npath = "capture.ply"\n'
        + ACTOR
        + 'clip = "carry"\nname = "one"\nspeed = 2.0\nloop = false\ncasts_shadow = false\nrelight = false\n'
        "position = [1, 0, 0]\nrotation_wxyz = [1, 0, 0, 1]\nscale = 2\n"
        "[[actors.keyframes]]\ntime = 0\nposition = [0, 0, 1]\nscale = 2\n"
        "[[actors.keyframes]]\ntime = 4\nposition = [0, 0, 3]\n"
        "[[cameras]]\neye = [0, 0, 5]\ntarget = [0, 0, 0]\n"
        "[animation]\nfps = 5\n[animation.lighting]\ndirect = 0.25\nshadow_map = { bins = 16 }\n"
        "lights_on_actors = false\n",
    )
    (actor,) = animation.actors
    assert (actor.name, actor.clip, actor.speed) == ("one", "carry", 2.0)
    assert not (actor.loop or actor.casts_shadow or actor.relight)
    assert ls.config.AvatarLightingConfig().lights_on_actors and not animation.lighting.lights_on_actors
    assert animation.lighting.direct == 0.25 and animation.lighting.shadow_map.bins == 16
    assert (animation.fps, animation.frame_count) == (5.0, 20)  # until the last keyframe
    assert len(animation.cameras) == 1
    assert len(animation.scene.splats) == 1
    (shown,) = animation.actors_at(2.0)
    # Scaled by 2, rotated by 90 degrees about z, translated; the keyframes scale by 2 again, and translate.
    np.testing.assert_allclose(shown.transform @ [1, 0, 0, 1], [2.0 * 1.0, 2.0 * 2.0, 2.0, 1.0], atol=1e-12)
    gaussians = expect_kind(ls.SplatInstance, shown).gaussians
    assert gaussians.count == 300
    bound = expect_kind(ls.RiggedGaussians, actor.subject)
    np.testing.assert_array_equal(gaussians.means, bound.at(4.0, "carry").means)


def test_load_returns_a_scene_with_actors_posed_at_time_0(folder: Path) -> None:
    """The scene equals the first frame of the animation."""
    text = '[[meshes]]\npath = "mesh.obj"\n' + ACTOR + "[[actors.keyframes]]\ntime = 0\nposition = [0, 0, 1]\n" + FRAMES
    scene = load_scene(folder, text)
    assert [instance.gaussians.count for instance in scene.splats] == [300, 4]
    assert scene.splats[0].transform[2, 3] == 1.0
    assert len(scene.meshes) == 1


def test_rigs_captures_meshes_and_frame_folders_can_be_actors(folder: Path) -> None:
    """Rigs and meshes become Gaussians or stay meshes; a file used twice is loaded once."""
    text = (
        ACTOR
        + ACTOR
        + '[[actors]]\npath = "tube.glb"\nform = "mesh"\n'
        + FRAMES
        + "fps = 2\n"
        + '[[actors]]\npath = "capture.ply"\n[[actors]]\npath = "mesh.obj"\ncount = 50\n'
        + '[[actors]]\npath = "mesh.obj"\nform = "mesh"\n'
    )
    animation = load_text(folder, text)
    kinds = [type(actor.subject).__name__ for actor in animation.actors]
    assert kinds == [*["RiggedGaussians"] * 2, "Rig", "GaussianSequence", "Gaussians", "Gaussians", "Mesh"]
    assert animation.actors[0].subject is animation.actors[1].subject
    assert expect_kind(ls.io.GaussianSequence, animation.actors[3].subject).fps == 2.0
    assert expect_kind(ls.Gaussians, animation.actors[5].subject).count == 50
    assert animation.frame_count == 38  # 1.5 s of frames, at 25 a second


def test_actor_keyframes_inherit_missing_values_from_the_previous_one(folder: Path) -> None:
    """The second keyframe states only a rotation, so position and scale stay."""
    text = (
        ACTOR + "[[actors.keyframes]]\ntime = 0\nposition = [1, 2, 3]\nscale = 2\n"
        "[[actors.keyframes]]\ntime = 1\nrotation_wxyz = [0, 0, 0, 1]\n"
    )
    motion = present(load_text(folder, text).actors[0].motion)
    np.testing.assert_allclose(motion.at(1.0), [[-2, 0, 0, 1], [0, -2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(
    ("animation", "count"),
    [
        ("fps = 10\nframes = 7", 7),
        ("fps = 10\nduration = 1.5", 15),
        ("duration = 2", 50),
        ("fps = 10", 10),  # one pass through the clip
        ("fps = 0.1", 1),
    ],
)
def test_animation_length_is_frames_or_else_duration_or_else_the_longest_actor(animation, count, folder):
    """The number of frames is ``frames``, or ``duration`` times ``fps``, or covers the longest actor."""
    assert load_text(folder, ACTOR + f"[animation]\n{animation}\n").frame_count == count


KEYS = "[[actors.keyframes]]\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[[splats]]\npath = 'capture.ply'", "has neither [[actors]] nor keyframes of a camera, light or material"),
        ("[actors]\npath = 'tube.glb'", "line 1: actors must be written with double brackets: [[actors]]"),
        ("[[actors]]\nclip = 'bend'", "line 1, actors[0]: lacks path"),
        (ACTOR + "clips = 'bend'", "line 4, actors[0]: unknown 'clips', did you mean 'clip'?"),
        (ACTOR + "clip = 'run'", "line 4, actors[0]: the rig has no clip 'run', it has 'bend', 'carry'"),
        (ACTOR + "speed = -1", "line 4, actors[0]: speed is -1, expected a number at least 0"),
        (ACTOR + "speed = nan", "line 4, actors[0]: speed is nan"),
        (ACTOR + "loop = 1", "line 4, actors[0]: loop is 1, expected true or false"),
        (ACTOR + "form = 'cloud'", "line 4, actors[0]: form is 'cloud', expected gaussians or mesh"),
        (ACTOR + "fps = 5", "line 4, actors[0]: fps applies to a folder of frames, but path is 'tube.glb', a rig"),
        (ACTOR + "form = 'mesh'", "line 3, actors[0]: count applies to a rig or a mesh as Gaussians, but path is"),
        (ACTOR + "scale = 0", "line 4, actors[0]: scale is 0, expected one positive number"),
        (ACTOR.replace("300", "0"), "line 3, actors[0]: count is 0, expected a whole number from 1"),
        ("[[actors]]\npath = 'none.glb'", "line 2, actors[0]: path is 'none.glb', no such file"),
        ("[[actors]]\npath = 'scene.toml'", "line 2, actors[0]: path is 'scene.toml', a scene file itself"),
        (FRAMES + "clip = 'bend'", "line 3, actors[0]: clip is 'bend', but the actor has no rig"),
        (
            FRAMES + "count = 5",
            "line 3, actors[0]: count applies to a rig or a mesh as Gaussians, but path is 'frames'",
        ),
        (FRAMES + "fps = 0", "line 3, actors[0]: fps is 0, expected a number above 0"),
        (ACTOR + "keyframes = 3", "line 4, actors[0]: keyframes is 3, expected tables, written with double brackets"),
        (ACTOR + KEYS + "position = [0, 0, 0]", "line 4, actors[0].keyframes[0]: lacks time, a number"),
        (ACTOR + KEYS + "time = 0\nposition = [0, nan, 0]", "line 6, actors[0].keyframes[0]: position is"),
        (ACTOR + KEYS + "time = 0\nrotation_wxyz = [0, 0, 0, 0]", "line 6, actors[0].keyframes[0]: rotation_wxyz is"),
        (ACTOR + KEYS + "time = nan", "line 5, actors[0].keyframes[0]: time is nan, expected a finite number"),
        (
            ACTOR + KEYS + "time = 2\n" + KEYS + "time = 1",
            "line 7, actors[0].keyframes[1]: time is 1, after 2: times must increase",
        ),
        (ACTOR + "[animation]\nfps = 0", "line 5, animation: fps is 0, expected a positive number"),
        (ACTOR + "[animation]\nframes = 0", "line 5, animation: frames is 0, expected at least 1"),
        (ACTOR + "[animation]\nduration = inf", "line 5, animation: duration is inf, expected a positive number"),
        (ACTOR + "[animation]\nduration = 1\nframes = 5", "line 6, animation: has both duration and frames"),
        (ACTOR + "[animation]\nduration = 1e9", "line 5, animation: has 2.5e+10 frames at fps = 25, expected at most"),
        (
            ACTOR + "[animation]\nfps = 2\nframes = 1000001",
            "line 6, animation: has 1,000,001 frames at fps = 2, expected",
        ),
        (ACTOR + "[animation]\nduration = 1e308", "line 5, animation: has inf frames"),
        (ACTOR + "[animation]\nrate = 5", "line 5, animation: unknown 'rate'"),
        (ACTOR + "[animation.lighting]\ndirekt = 0.5", "line 5, animation.lighting: unknown 'direkt', did you mean"),
        (
            ACTOR + "[animation.lighting]\nshadow.bins = 16",
            "line 5, animation.lighting: unknown 'shadow', did you mean 'shadows'?",
        ),
        (ACTOR + "[animation.lighting]\ndirect = 2", "line 5, animation.lighting: direct is 2, expected 0.0 to 1.0"),
    ],
)
def test_error_for_an_invalid_actor_of_a_scene_file_names_file_line_and_key(
    text: str, problem: str, folder: Path
) -> None:
    """The error is one line."""
    write_scene(folder, text)
    with pytest.raises(ls.FormatError) as caught:
        ls.load_animation(folder / "scene.toml")
    refuses(caught, folder, problem)


def test_error_in_the_file_of_an_actor_names_that_file(folder: Path) -> None:
    """The error does not name the scene file."""
    rig = TubeRig(clips={"bend": BEND})
    present(rig.weights)[:] = 0.0
    rig.write(folder / "tube.glb")
    with pytest.raises(ls.FormatError, match=r"tube\.glb: .* is skinned, but 130 vertices have no weight"):
        load_text(folder, ACTOR)
    for path in (folder / "frames").iterdir():
        path.unlink()
    with pytest.raises(ls.FormatError, match="frames: holds no frames"):
        load_text(folder, FRAMES)
