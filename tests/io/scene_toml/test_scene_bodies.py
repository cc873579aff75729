"""Actors of scene files that are body models, or have motion from another file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.body_files import body_file, person_bvh, pose_file
from support.files.rig_files import BEND, CARRY, TubeRig
from support.files.scene_files import refuses, write_scene
from support.kinds import expect_kind
from support.scenes.raster_scenes import random_gaussians


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Writes a capture, a body with poses, a rig, and a motion."""
    ls.save(tmp_path / "capture.ply", random_gaussians(1, count=10))
    body_file(tmp_path / "smpl.npz", "SMPL")
    pose_file(tmp_path / "walk.npz", "SMPL")
    TubeRig(clips={"bend": BEND}).write(tmp_path / "tube.glb")
    (tmp_path / "walk.bvh").write_text("HIERARCHY")
    np.save(tmp_path / "w.npy", np.ones((10, 2)))
    (tmp_path / "walk.pkl").write_bytes(b"")
    (tmp_path / "hop.bvh").write_text(person_bvh(f"0 40 0{' 0' * 27}\n0 40 33{' 0' * 27}\n"))
    return tmp_path


def test_body_models_with_motion_are_actors_that_stand(folder: Path) -> None:
    """The body has the shape and the motion of its keys, stands in a scene whose y points down, and is saved again."""
    (folder / "away").mkdir()
    entry = '[[actors]]\npath = "smpl.npz"\nmotion = "walk.npz"\nform = "mesh"\n'
    text = 'up = "y-down"\n[[splats]]\npath = "capture.ply"\n' + entry + entry + "betas = [1.0, 2]\n"
    first, second = ls.load_animation(write_scene(folder, text)).actors
    rig = expect_kind(ls.avatars.Rig, second.subject)
    assert rig.clips == ("walk",) and first.subject is not rig
    expected = ls.avatars.load_rig(folder / "smpl.npz", motion=folder / "walk.npz", betas=[1.0, 2.0]).pose(0.05)
    shown = expect_kind(ls.MeshInstance, second.at(0.05)[0])
    np.testing.assert_array_equal(shown.mesh.positions, expected.positions)
    np.testing.assert_allclose(shown.transform[:3, 1] / np.linalg.norm(shown.transform[:3, 1]), [0, -1, 0], atol=1e-9)
    ls.io.SceneDocument.open(folder / "scene.toml").save(folder / "away" / "scene.toml")
    assert 'motion = "../walk.npz"' in (folder / "away" / "scene.toml").read_text()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "path = 'tube.glb'\nbetas = [1]",
            "line 3, actors[0]: betas applies to a body model, but path is 'tube.glb', a rig",
        ),
        ("path = 'smpl.npz'\nbetas = 1", "line 3, actors[0]: betas is 1, expected numbers in brackets"),
        ("path = 'tube.glb'\nmotion = 'no.bvh'", "line 3, actors[0]: motion is 'no.bvh', no such file"),
        (
            "path = 'tube.glb'\nmotion = 'walk.bvh'",
            "line 3, actors[0]: motion 'walk.bvh' ends before its MOTION: expected a BVH file",
        ),
        (
            "path = 'smpl.npz'\nmotion = 'walk.pkl'",
            "line 3, actors[0]: motion 'walk.pkl' is not read as a motion: save its poses of SMPL",
        ),
        (
            "path = 'smpl.npz'\njoints = { a = 'pelvis' }",
            "line 3, actors[0]: joints are those of a motion, but there is no motion",
        ),
        (
            "path = 'smpl.npz'\nmotion = 'walk.npz'\njoints = { a = 1 }",
            'line 4, actors[0]: joints is {\'a\': 1}, expected names of SMPL, such as { "Shin.L" = "left_knee" }',
        ),
        (
            "path = 'smpl.npz'\nmotion = 'hop.bvh'\njoints = { Shin = 'left_knee' }",
            "line 4, actors[0]: joints has unknown 'Shin', expected Hips, Chest, Tail, LeftHip",
        ),
        ("path = 'walk.bvh'", "line 2, actors[0]: path is 'walk.bvh', a motion without a body: write path ="),
        ("path = 'tube.glb'\nweights = 'w.npy'", "line 3, actors[0]: weights is that of a capture, but there is no"),
        ("path = 'tube.glb'\npose = 0.5", "line 3, actors[0]: pose is that of a capture, but there is no gaussians"),
        (
            "path = 'tube.glb'\ngaussians = 'capture.ply'\npose = nan",
            "line 4, actors[0]: pose is nan, expected a time of the clip, a finite number of seconds",
        ),
        ("path = 'tube.glb'\ngaussians = 'capture.ply'\ncount = 3", "line 4, actors[0]: count and gaussians are both"),
        (
            "path = 'tube.glb'\ngaussians = 'capture.ply'\nweights = 'w.npy'",
            "line 4, actors[0]: weights has shape (10, 2), expected (10, 5) or (10, 3): Gaussians x joints of the rig",
        ),
        (
            "path = 'tube.glb'\ngaussians = 'tube.glb'",
            "line 3, actors[0]: gaussians is 'tube.glb', which is no capture",
        ),
    ],
)
def test_errors_of_bodies_and_motions_name_the_line(folder: Path, text: str, problem: str) -> None:
    """The error is one line."""
    write_scene(folder, f"[[actors]]\n{text}\n")
    with pytest.raises(ls.FormatError) as caught:
        ls.load_animation(folder / "scene.toml")
    refuses(caught, folder, problem)


def test_the_error_about_unknown_joints_has_toml_that_names_them(folder: Path) -> None:
    """The table of the error is that of the entry, with the name of a joint."""
    (folder / "hop.bvh").write_text((folder / "hop.bvh").read_text().replace("LeftKnee", "Lshnk"))
    entry = "[[actors]]\npath = 'smpl.npz'\nmotion = 'hop.bvh'\n"
    with pytest.raises(ls.FormatError, match=r"Say which is the left_knee: (joints = \{.*\}), or rename") as caught:
        ls.load_animation(write_scene(folder, entry))
    shown = str(caught.value).partition("left_knee: ")[2].partition(", or rename")[0]
    assert ls.load_animation(write_scene(folder, entry + shown.replace("NAME", "Lshnk") + "\n")).actors


def test_actors_of_vrm_files_equal_those_of_glb_files(folder: Path) -> None:
    """A .vrm is a GLB file with another extension, as a rig and as a scene."""
    (folder / "tube.vrm").write_bytes((folder / "tube.glb").read_bytes())
    entry = '[[actors]]\npath = "tube.{}"\nform = "mesh"\n'
    actors = ls.load_animation(write_scene(folder, entry.format("vrm") + entry.format("glb"))).actors
    shown = [expect_kind(ls.MeshInstance, actor.at(0.6)[0]).mesh.positions for actor in actors]
    np.testing.assert_array_equal(shown[0], shown[1])
    assert expect_kind(ls.Scene, ls.load(folder / "tube.vrm")).meshes


def test_a_capture_is_bound_to_the_rig_of_its_entry(folder: Path) -> None:
    """The actor equals the capture bound in Python, with and without weights, and its files are saved along."""
    np.savez(folder / "w.npz", weights=np.eye(10, 3) + 0.1)
    text = '[[actors]]\npath = "tube.glb"\ngaussians = "capture.ply"\n'
    first, second = ls.load_animation(write_scene(folder, text + text + 'weights = "w.npz"\n')).actors
    rig, capture = ls.avatars.load_rig(folder / "tube.glb"), random_gaussians(1, count=10)
    for actor, weights in ((first, None), (second, np.eye(10, 3) + 0.1)):
        expected = ls.bind_gaussians(rig, gaussians=capture, weights=weights).at(0.6)
        shown = expect_kind(ls.SplatInstance, actor.at(0.6)[0]).gaussians
        np.testing.assert_allclose(shown.means, expected.means, atol=1e-5)
    (folder / "away").mkdir()
    ls.io.SceneDocument.open(folder / "scene.toml").save(folder / "away" / "scene.toml")
    assert 'weights = "../w.npz"' in (folder / "away" / "scene.toml").read_text()


def test_pose_of_an_actor_is_a_time_of_its_clip(folder: Path) -> None:
    """The capture is as it was in that pose, of the clip that the entry names, and moves from there."""
    TubeRig(clips={"bend": BEND, "carry": CARRY}).write(folder / "tube.glb")
    entry = '[[actors]]\npath = "tube.glb"\ngaussians = "capture.ply"\npose = 0.8\nclip = "{}"\n'
    actors = ls.load_animation(write_scene(folder, entry.format("bend") + entry.format("carry"))).actors
    rig, capture = ls.avatars.load_rig(folder / "tube.glb"), random_gaussians(1, count=10)
    for actor, clip in zip(actors, ("bend", "carry"), strict=True):
        shown = [expect_kind(ls.SplatInstance, actor.at(time)[0]).gaussians.means for time in (0.8, 0.3)]
        np.testing.assert_allclose(shown[0], capture.means, atol=1e-5)
        expected = ls.bind_gaussians(rig, gaussians=capture, pose=rig.pose_at(0.8, clip)).at(0.3, clip).means
        np.testing.assert_allclose(shown[1], expected, atol=1e-5)
