"""BVH files: forward kinematics by hand, and malformed files."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.rigs.bvh import read_bvh

ORDERS = ["".join(order) for order in itertools.permutations("XYZ")]


def arm_bvh(order: str = "ZXY", frames: str = "10 20 30 15 -25 35 50\n1 2 3 4 5 6 -7\n") -> str:
    """Returns a file with a root, an elbow with one rotation, and an end site."""
    turns = " ".join(f"{axis}rotation" for axis in order)
    return (
        "HIERARCHY\nROOT Hips\n{\n  OFFSET 7.0 8.0 9.0\n"
        f"  CHANNELS 6 Xposition Yposition Zposition {turns}\n"
        "  JOINT Left Elbow\n  {\n    OFFSET 1.0 2.0 0.5\n    CHANNELS 1 Yrotation\n"
        "    End Site\n    {\n      OFFSET 0.0 3.0 0.0\n    }\n  }\n}\n"
        f"MOTION\nFrames: 2\nFrame Time: 0.025\n{frames}"
    )


def about(axis: str, degrees: float) -> np.ndarray:
    """Returns the rotation matrix about one axis."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = cosine
    matrix[first, second], matrix[second, first] = -sine, sine
    return matrix


@pytest.mark.parametrize("order", ORDERS)
def test_bvh_poses_equal_forward_kinematics_by_hand(tmp_path: Path, order: str) -> None:
    """Rotations multiply in the order of the channels, positions replace offsets, and frames have the stated rate."""
    path = tmp_path / "arm.bvh"
    path.write_text(arm_bvh(order))
    skeleton, clip = read_bvh(path)
    assert (skeleton.names, clip.name, clip.duration) == (("Hips", "Left Elbow"), "arm", 0.025)
    rest = skeleton.world_from_node()
    np.testing.assert_array_equal(rest[1, :3, 3], [8.0, 10.0, 9.5])
    for time, row in ((0.0, [10, 20, 30, 15, -25, 35, 50]), (0.025, [1, 2, 3, 4, 5, 6, -7])):
        root = about(order[0], row[3]) @ about(order[1], row[4]) @ about(order[2], row[5])
        world = skeleton.world_from_node(clip, time)
        np.testing.assert_allclose(world[0, :3, :3], root, atol=1e-14)
        np.testing.assert_allclose(world[1, :3, 3], root @ [1.0, 2.0, 0.5] + row[:3], atol=1e-13)
        np.testing.assert_allclose(world[1, :3, :3], root @ about("Y", row[6]), atol=1e-14)


def test_bvh_with_a_frame_more_than_it_states_is_read_without_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Some programs count wrong by one; a line says what is left out."""
    path = tmp_path / "arm.bvh"
    path.write_text(arm_bvh().replace("Frames: 2", "Frames: 1"))
    _, clip = read_bvh(path)
    assert clip.duration == 0.0
    assert "has 2 frames, but states 1: the last one is left out" in caplog.text


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("CHANNELS 1", "CHANNELS 2", "line 9: expected CHANNELS, their number and names such as Zrotation"),
        ("Yrotation\n    End", "Wrotation\n    End", "line 9: expected CHANNELS"),
        ("OFFSET 1.0", "OFSET 1.0", "line 8: 'OFSET 1.0 2.0 0.5' is not expected here in a BVH file"),
        ("0.5\n", "half\n", "damaged, or not a BVH file"),
        ("Frames: 2", "Frames: 3", "has 2 frames of 7 numbers, expected 3 of 7, as it states"),
        ("-7", "", "damaged, or not a BVH file"),
        ("-7", "nan", "has numbers that are not finite"),
        ("Time: 0.025", "Time: 0", "has 2 frames of 0 s, expected at least one above 0 s"),
        ("Frames: 2\n", "", "line 18: expected 'Frames: N' and 'Frame Time: SECONDS'"),
        ("MOTION", "", "line 17: 'Frames: 2' is not expected here"),
        ("HIERARCHY", "<html>", "line 1: '<html>' is not expected here in a BVH file"),
    ],
)
def test_malformed_bvh_files_give_one_line(tmp_path: Path, old: str, new: str, problem: str) -> None:
    """The line says where the file is wrong, and what was expected."""
    path = tmp_path / "arm.bvh"
    path.write_text(arm_bvh().replace(old, new, 1))
    with pytest.raises(ls.FormatError) as caught:
        read_bvh(path)
    assert problem in str(caught.value) and "\n" not in str(caught.value)


def test_truncated_bvh_files_raise_only_format_errors(tmp_path: Path) -> None:
    """Only the last digits of the last number may be cut off unnoticed."""
    path = tmp_path / "arm.bvh"
    text = arm_bvh()
    for length in range(len(text) - 3):
        path.write_text(text[:length])
        with pytest.raises(ls.FormatError):
            read_bvh(path)
