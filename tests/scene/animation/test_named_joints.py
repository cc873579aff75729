"""Joints whose names are not known: what errors say about them, and what `joints` of a motion names."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.animation.retargeting import human_joints
from lumisplat.scene.animation.rig import Rig, RigPart, RigSurface
from support.files.body_files import body_file, person_bvh, pose_file

STILL = f"0 40 0{' 0' * 27}\n0 40 33{' 0' * 27}\n"


def test_motions_with_unknown_joints_fit_after_the_advice_of_their_error(tmp_path: Path) -> None:
    """The error has names of the file; joints are named by the argument that it shows, or renamed as it shows."""
    known = person_bvh(STILL)
    path, rig = tmp_path / "hop.bvh", ls.avatars.load_rig(body_file(tmp_path / "smpl.npz", "SMPL"))
    path.write_text(known)
    expected = ls.avatars.load_motion(path, rig).pose(0.4).positions
    path.write_text(known.replace("Knee", "-Shin.x"))
    with pytest.raises(
        ls.FormatError, match=r"known as left_knee, right_knee; its other joints are Tail, Left-Shin\.x, R"
    ) as one:
        ls.avatars.load_motion(path, rig)
    shown = re.search(r"Say which is the left_knee: joints=(\{.*\}), or rename it to (.*)$", str(one.value))
    assert shown
    for name in shown[2].split(" or "):
        path.write_text(known.replace("RightKnee", "R").replace("LeftKnee", name))
        named = ls.avatars.load_motion(path, rig, joints={"R": "right_knee"})
        np.testing.assert_allclose(named.pose(0.4).positions, expected, atol=1e-6)
    joints = eval(shown[1].replace("NAME", "Left-Shin.x")) | {"Right-Shin.x": "right_knee"}
    path.write_text(known.replace("Knee", "-Shin.x"))
    named = ls.avatars.load_rig(tmp_path / "smpl.npz", motion=path, joints=joints)
    np.testing.assert_allclose(named.pose(0.4).positions, expected, atol=1e-6)
    for wrong, problem in (
        ({"Left-Shin": "left_knee"}, "joints has unknown 'Left-Shin', did you mean 'Left-Shin.x'?"),
        ({"Left-Shin.x": "left_kne"}, "joints has unknown 'left_kne', did you mean 'left_knee'?"),
    ):
        with pytest.raises(ls.SceneError, match=re.escape(problem)):
            ls.avatars.load_motion(path, rig, joints=wrong)
    with pytest.raises(ls.SceneError, match="joints are those of a motion, but there is no motion"):
        ls.avatars.load_rig(tmp_path / "smpl.npz", joints=joints)
    with pytest.raises(ls.SceneError, match=r"joints applies to other motions than walk\.npz"):
        ls.avatars.load_motion(pose_file(tmp_path / "walk.npz", "SMPL"), rig, joints=joints)


def person(thigh: str = "UpLeg", shin: str = "Leg", **more: tuple[str | None, tuple[float, float, float]]) -> Rig:
    """Returns a rig of hips and legs, whose thighs and shins have the given names, and of further joints."""
    joints: dict[str, tuple[str | None, tuple[float, float, float]]] = {"Hips": (None, (0.0, 0.95, 0.0))}
    for side, x in (("Left", 0.09), ("Right", -0.09)):
        joints |= {f"{side}{thigh}": ("Hips", (x, 0.88, 0.0)), f"{side}{shin}": (f"{side}{thigh}", (x, 0.48, 0.0))}
        joints[f"{side}Foot"] = f"{side}{shin}", (x, 0.08, 0.0)
    return Rig.of_joints(joints | more)


@pytest.mark.parametrize(("thigh", "shin"), [("UpLeg", "Leg"), ("Leg", "Shin"), ("Leg", "Bottom"), ("Top", "Leg")])
def test_names_that_mean_other_joints_in_the_rig_are_those_of_the_motion(tmp_path: Path, thigh: str, shin: str) -> None:
    """Leg is the thigh in the motion, and the shin in some rigs; others name the thigh as the motion does."""
    path = tmp_path / "walk.bvh"
    rows = f"0 40 0{' 0' * 27}\n0 40 0{' 0' * 9}  0 40 0  0 -20 0  0 0 0{' 0' * 9}\n"
    path.write_text(person_bvh(rows))
    expected = ls.avatars.load_motion(path, person()).animations[0]
    path.write_text(re.sub(r"(Left|Right)Hip\b", r"\1Leg", re.sub("(Left|Right)Knee", r"\1Shin", person_bvh(rows))))
    named = {f"{side}{name}": f"{side.lower()}_{joint}" for side in ("Left", "Right")
             for name, joint in {thigh: "hip", shin: "knee", "Leg": "hip", "Shin": "knee"}.items()}  # fmt: skip
    found = ls.avatars.load_motion(path, person(thigh, shin), joints=named).animations[0]
    for one, other in zip(found.tracks, expected.tracks, strict=True):
        assert one.node == other.node
        np.testing.assert_allclose(one.values, other.values, atol=1e-9)


def test_joints_of_a_rig_that_are_matrices_are_not_called_unknown(tmp_path: Path) -> None:
    """Names do not help."""
    path, rig = tmp_path / "hop.bvh", person()
    path.write_text(person_bvh(STILL))
    fixed = replace(rig, skeleton=replace(rig.skeleton, matrices={2: np.eye(4), 3: np.eye(4)}))
    problem = "the rig has joints that are given as matrices, which clips do not move: LeftLeg, LeftFoot"
    for joints in ({}, {"LeftLeg": "left_knee"}):
        with pytest.raises(ls.FormatError, match=f"does not fit the rig: {problem}$"):
            ls.avatars.load_motion(path, fixed, joints=joints)


@pytest.mark.parametrize(
    ("named", "spine"),
    [
        ({}, ["Spine", "Spine1", "Chest"]),
        ({"Waist": "spine1"}, ["Waist", "Spine", "Chest"]),
        ({"Waist": "spine3"}, ["Spine", "Chest", "Waist"]),
        ({"Waist": "spine1", "Spine": "spine2", "Spine1": "spine3"}, ["Waist", "Spine", "Spine1"]),
    ],
)
def test_named_joints_of_a_spine_stay_those_that_they_are_named(named: dict[str, str], spine: list[str]) -> None:
    """The others are the lowest and the highest of the rest."""
    height = (0.0, 1.2, 0.0)
    rig = person(Waist=("Hips", height), Spine=("Waist", height), Spine1=("Spine", height), Chest=("Spine1", height))
    joints = human_joints(rig.skeleton, named)
    assert [rig.skeleton.names[joints[f"spine{k}"]] for k in (1, 2, 3)] == spine


def test_joints_that_move_no_skin_themselves_are_known_above_those_that_do_and_by_their_names(tmp_path: Path) -> None:
    """Only a thigh has skin: the hips above it are known, and the other joints once the user names them."""
    bare = person(thigh="Thigh", shin="Shin")
    thigh = bare.skeleton.names.index("LeftThigh")
    part = RigPart(
        positions=np.array([[0.0, 0.5, 0.0], [0.1, 0.5, 0.0], [0.0, 0.8, 0.0]], np.float32),
        normals=None,
        nodes=np.array([thigh], np.int32),
        joint_from_bind=np.asarray(np.linalg.inv(bare.skeleton.world_from_node()[[thigh]]), np.float64),
        joints=np.zeros((3, 1), np.int32),
        weights=np.ones((3, 1), np.float32),
    )
    surface = RigSurface((part,), np.array([[0, 1, 2]], np.int32), ls.MaterialPbr(), None, None, "thigh")
    rig = replace(bare, surfaces=(surface,))
    (tmp_path / "hop.bvh").write_text(person_bvh(STILL))
    with pytest.raises(ls.FormatError, match="the rig has no joint known as left_hip, left_knee"):
        ls.avatars.load_motion(tmp_path / "hop.bvh", rig)
    legs = {"Thigh": "hip", "Shin": "knee", "Foot": "ankle"}
    joints = {f"{side}{own}": f"{side.lower()}_{joint}" for side in ("Left", "Right") for own, joint in legs.items()}
    moved = ls.avatars.load_motion(tmp_path / "hop.bvh", rig, joints=joints)
    hips = [moved.skeleton.world_from_node(moved.animations[0], time)[0, :3, 3] for time in (0.0, 0.5)]
    np.testing.assert_allclose(hips[1] - hips[0], [0.0, 0.0, 0.8], atol=1e-6)  # 33 inches, by legs of 0.8 m
