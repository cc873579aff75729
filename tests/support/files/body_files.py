"""Small body models with the layout of SMPL's files, AMASS poses and BVH files, made up by the tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lumisplat.io.rigs.body_model import FAMILY

_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
_PLACES = {
    "pelvis": (0.0, -0.2, 0.0), "left_hip": (0.07, -0.3, 0.0), "left_knee": (0.1, -0.7, 0.01),
    "left_ankle": (0.09, -1.1, -0.03), "left_foot": (0.12, -1.16, 0.1), "spine1": (0.0, -0.1, -0.03),
    "spine2": (0.0, 0.03, 0.0), "spine3": (0.0, 0.08, 0.03), "neck": (0.0, 0.3, -0.02), "head": (0.0, 0.38, 0.03),
    "left_collar": (0.08, 0.2, 0.0), "left_shoulder": (0.17, 0.24, -0.02), "left_elbow": (0.43, 0.23, -0.04),
    "left_wrist": (0.68, 0.24, -0.03), "left_hand": (0.76, 0.23, -0.03), "jaw": (0.0, 0.36, 0.05),
    "left_eye": (0.03, 0.42, 0.09), "root": (0.0, 0.0, 0.0),
}  # fmt: skip
_FINGERS = {"index": 0.03, "middle": 0.01, "pinky": -0.03, "ring": -0.01, "thumb": 0.05}


def joint_place(name: str) -> np.ndarray:
    """Returns where a joint of a person with spread arms is, metres, y up, shape (3,)."""
    left = name.replace("right", "left")
    if left[:-1].removeprefix("left_") in _FINGERS:
        along = 0.07 + 0.03 * int(left[-1])
        place = np.add(_PLACES["left_wrist"], (along, 0.0, _FINGERS[left[:-1].removeprefix("left_")]))
    else:
        place = np.array(_PLACES[left])
    return place * (-1.0, 1.0, 1.0) if "right" in name else place


def joint_parents(model: str) -> list[int]:
    """Returns the parents of the joints of a model, -1 for the root."""
    if model == "FLAME":
        return [-1, 0, 1, 1, 1]
    names = FAMILY[model]
    parents = list(_PARENTS)
    for joint, name in enumerate(names[22:], 22):
        if name in ("jaw", "left_eye", "right_eye"):
            parents.append(names.index("head"))
        else:
            is_first = name[-1] not in "23"
            parents.append(names.index(f"{name.partition('_')[0]}_wrist") if is_first else joint - 1)
    return parents


def body_arrays(model: str, seed: int = 0, directions: int = 20, *, rigid: bool = False) -> dict[str, Any]:
    """Returns the arrays of a body model: a small tetrahedron at every joint, and random directions and weights.

    Args:
        model: Name of the model: SMPL, SMPL-H, SMPL-X or FLAME.
        seed: Seed of the random numbers.
        directions: Number of shapes, or of shapes and expressions.
        rigid: Whether each tetrahedron moves with its joint alone, without pose blend shapes.
    """
    rng = np.random.default_rng(seed)
    names = FAMILY[model]
    count, vertices = len(names), 4 * len(names)
    corners = 0.04 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
    places = np.array([joint_place(name) for name in names])
    weights = np.kron(np.eye(count), np.full((4, 1), 0.7))
    for row in weights if not rigid else ():
        row[rng.integers(0, count, 3)] += 0.1
    regressor = np.kron(np.eye(count), np.full((1, 4), 0.25))
    tree = np.array([joint_parents(model), range(count)], np.int64)
    arrays = {
        "v_template": (places[:, None] + corners).reshape(-1, 3),
        "shapedirs": 0.01 * rng.standard_normal((vertices, 3, directions)),
        "posedirs": (0.0 if rigid else 0.003) * rng.standard_normal((vertices, 3, 9 * (count - 1))),
        "J_regressor": regressor,
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.where(tree < 0, 2**32 - 1, tree).astype(np.uint32),
        "f": np.concatenate([4 * k + np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]) for k in range(count)]),
        "joint2num": np.array({"Pelvis": 0}, dtype=object),
    }
    if model in ("SMPL-H", "SMPL-X"):
        arrays |= {name: 0.3 * rng.standard_normal(45) for name in ("hands_meanl", "hands_meanr")}
    return arrays


def body_file(path: Path, model: str, **options: Any) -> Path:
    """Writes a body model; ``options`` are those of `body_arrays`."""
    np.savez(path, **body_arrays(model, **options))
    return path


def pose_file(path: Path, model: str, frames: int = 3, seed: int = 1, **changes: Any) -> Path:
    """Writes AMASS poses of a standing person, z up; ``changes`` replace arrays, or leave them out if None."""
    rng = np.random.default_rng(seed)
    poses = 0.4 * rng.standard_normal((frames, len(FAMILY[model]), 3))
    poses[:, 0] = np.array([np.pi / 2.0, 0.0, 0.0]) + 0.1 * rng.standard_normal((frames, 3))
    arrays = {
        "poses": poses.reshape(frames, -1),
        "trans": rng.standard_normal((frames, 3)),
        "betas": rng.standard_normal(16),
        "mocap_framerate": np.array(20.0),
        "gender": np.array("male", dtype=object),
    } | changes
    np.savez_compressed(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def person_bvh(rows: str, spread: float = 0.0) -> str:
    """Returns a BVH file of a person in inches with hips, a chest and legs, whose root has three rotations.

    Args:
        rows: Lines of channels, one every 0.5 s.
        spread: Angle of each leg, with its foot, to the vertical at rest, degrees.
    """
    turns = "CHANNELS 3 Zrotation Xrotation Yrotation\n"

    def leg(side: str, x: float) -> str:
        angle = np.radians(np.copysign(spread, x))

        def offset(down: float, ahead: float = 0.0) -> str:
            return f"OFFSET {down * np.sin(angle)} {-down * np.cos(angle)} {ahead}\n"

        return (
            f"JOINT {side}Hip\n{{\nOFFSET {x} -2 0\n{turns}JOINT {side}Knee\n{{\n{offset(17.0)}{turns}"
            f"JOINT {side}Ankle\n{{\n{offset(16.0)}{turns}End Site\n{{\n{offset(2.0, 4.0)}}}\n}}\n}}\n}}\n"
        )

    return (
        "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\n"
        "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
        f"JOINT Chest\n{{\nOFFSET 0 5 0\n{turns}End Site\n{{\nOFFSET 0 10 0\n}}\n}}\n"
        f"JOINT Tail\n{{\nOFFSET 0 0 -1\n{turns}}}\n{leg('Left', 4.0)}{leg('Right', -4.0)}}}\n"
        f"MOTION\nFrames: {rows.count(chr(10))}\nFrame Time: 0.5\n{rows}"
    )
