"""Joints whose names are not known: what errors say about them, and what `joints` of a motion names."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.animation.retargeting import human_joints
from lumisplat.scene.animation.rig import Rig
from support.files.body_files import person_bvh


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
