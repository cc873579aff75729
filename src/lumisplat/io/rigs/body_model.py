"""Reads body models of the SMPL family from NumPy archives, and makes rigs of them.

A vertex is the template plus shape, expression and pose blend shapes, moved by linear blend skinning about joints that
are regressed from the shaped template (Loper et al. 2015, equations 2 to 10; SMPL-X: Pavlakos et al. 2019). The axes
are y up, +z to the front, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.source import parsing
from lumisplat.math.arrays import Doubles, IntArray, finite_array, read_only_view
from lumisplat.math.transforms import quaternions_from_rotation_vectors
from lumisplat.scene.animation.rig import PoseShapes, Rig, RigPart, RigSurface, Skeleton
from lumisplat.scene.materials import MaterialPbr

_SPINE = ("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle")
_CHEST = ("spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head")
_ARMS = ("left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist")
_BODY = (*_SPINE, *_CHEST, *_ARMS)
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_HANDS = tuple(f"{side}_{finger}{k}" for side in ("left", "right") for finger in _FINGERS for k in (1, 2, 3))
_FACE = ("jaw", "left_eye", "right_eye")
FLAME = ("root", "neck", *_FACE)
"""Joints of the head model FLAME."""
SMPL = (*_BODY, "left_hand", "right_hand")
"""The 24 joints of SMPL."""
SMPLH = (*_BODY, *_HANDS)
"""The 52 joints of SMPL-H (SMPL+H), whose bodies have the shape space of SMPL."""
SMPLX = (*_BODY, *_FACE, *_HANDS)
"""The 55 joints of SMPL-X."""
FAMILY = {"SMPL": SMPL, "SMPL-H": SMPLH, "SMPL-X": SMPLX, "FLAME": FLAME}
"""Joints of each model, in the order of the files; models differ in the number of joints."""

_REQUIRED = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
_HAND_MEANS = ("hands_meanl", "hands_meanr")
ARRAYS = (*_REQUIRED, *_HAND_MEANS)
"""Names of the arrays that a model is made of."""
_SHAPES_SPLIT = 400, 300, 10
"""Models with at least 400 shapes and expressions have 300 shapes, others 10; the rest are expressions."""
_KIND = "a body model (SMPL)"


@dataclass(frozen=True, slots=True, eq=False)
class BodyModel:
    """Content of a body model file: V vertices, J joints, S shapes and E expressions."""

    path: Path
    name: str
    """Key of `FAMILY`."""
    template: Doubles
    """Vertices of the mean body, metres, shape (V, 3)."""
    shapes: Doubles
    """Offset of each vertex by each of S shapes, shape (V, 3, S)."""
    expressions: Doubles
    """Offset of each vertex by each of E expressions, shape (V, 3, E); E is 0 for models without a face."""
    pose_offsets: npt.NDArray[np.float32]
    """Offset of each vertex by each entry of the rotations of all joints but the root, shape (9 (J - 1), V, 3)."""
    regressor: Doubles
    """Weights with which vertices make joints, shape (J, V)."""
    weights: Doubles
    """Skinning weights, shape (V, J)."""
    parents: tuple[int | None, ...]
    """Index of the parent of each of J joints; a parent comes before its children, and the first joint is the root."""
    faces: IntArray
    """Triangles, shape (F, 3)."""
    hands: Doubles
    """Mean pose of the hands, rotation vectors of the last joints, shape (30, 3); (0, 3) for models without hands."""

    def rig(self, betas: npt.ArrayLike | None = None, expression: npt.ArrayLike | None = None) -> Rig:
        """Returns the rig of a body, without clips; at rest its arms are spread and its hands relaxed (the mean hands).

        Args:
            betas: Up to S coefficients of shapes, the first ones; the others are 0. None: the mean body.
            expression: Up to E coefficients of expressions; None: a neutral face.

        Raises:
            SceneError: Coefficients are not finite numbers, or are more than the model has.
        """
        shape, face = self.shapes, self.expressions
        shaped = self.template + shape @ _padded("betas", betas, shape) + face @ _padded("expression", expression, face)
        joints = self.regressor @ shaped
        count = len(self.parents)
        parents = np.array([parent or 0 for parent in self.parents])
        translations = joints - joints[parents]
        translations[0] = joints[0]
        rotations = np.zeros((count, 3))
        rotations[count - len(self.hands) :] = self.hands
        skeleton = Skeleton(
            self.parents,
            tuple(range(count)),
            translations,
            quaternions_from_rotation_vectors(rotations),
            np.ones((count, 3)),
            {},
            FAMILY[self.name],
        )
        bind = np.tile(np.eye(4), (count, 1, 1))
        bind[:, :3, 3] = -joints
        influences = int(np.count_nonzero(self.weights, axis=1).max())
        strongest = np.argsort(-self.weights, axis=1, kind="stable")[:, :influences]
        part = RigPart(
            positions=read_only_view(shaped.astype(np.float32)),
            normals=read_only_view(_vertex_normals(shaped, self.faces)),
            nodes=np.arange(count, dtype=np.int32),
            joint_from_bind=bind,
            joints=strongest.astype(np.int32),
            weights=np.take_along_axis(self.weights, strongest, axis=1).astype(np.float32),
            pose_shapes=PoseShapes(
                np.arange(1, count, dtype=np.int32), parents[1:].astype(np.int32), self.pose_offsets
            ),
        )
        return Rig(skeleton, (RigSurface((part,), self.faces, MaterialPbr(), None, None, self.path.stem),), ())


def read_body_model(path: Path) -> BodyModel:
    """Reads a SMPL, SMPL-H, SMPL-X or FLAME model; objects in the archive, such as tables of names, are not read.

    Args:
        path: A ``.npz`` file.

    Raises:
        FormatError: The file is damaged, is no body model, or a needed array holds Python objects.
        MissingFileError: There is no such file.
    """
    with parsing(path, _KIND):
        arrays = read_arrays(path, _KIND, compressed=True, names=(*ARRAYS, "poses"))
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing and "poses" in arrays:
            raise FormatError(path, f'holds poses, not a body: load_rig("SMPLX_NEUTRAL.npz", motion="{path.name}")')
        if missing:
            raise FormatError(path, f"lacks {', '.join(missing)}: expected a model of {', '.join(FAMILY)}")
        return _body_model(path, arrays)


def _body_model(path: Path, arrays: dict[str, npt.NDArray[Any]]) -> BodyModel:
    """Checks the arrays of a model, and returns them as a `BodyModel`."""
    template = checked_array(arrays, "v_template", (None, 3), np.float64)
    vertices = len(template)
    weights = checked_array(arrays, "weights", (vertices, None), np.float64)
    joints = weights.shape[1]
    name = next((name for name, names in FAMILY.items() if len(names) == joints), None)
    if name is None:
        expected = ", ".join(f"{len(names)} ({name})" for name, names in FAMILY.items())
        raise FormatError(path, f"has {joints} joints, expected {expected}")
    if (weights < 0.0).any() or not weights.any(axis=1).all():
        raise ValueError("weights below 0, or a vertex without weights")
    shapes = checked_array(arrays, "shapedirs", (vertices, 3, None), np.float64)
    all_of_them, many, few = _SHAPES_SPLIT
    split = shapes.shape[2]
    if name in ("SMPL-X", "FLAME"):
        split = many if split >= all_of_them else few
    offsets = checked_array(arrays, "posedirs", (vertices, 3, 9 * (joints - 1)), np.float32)
    tree = checked_array(arrays, "kintree_table", (2, joints), np.int64)[0].tolist()
    if any(not 0 <= parent < joint for joint, parent in enumerate(tree) if joint):
        raise ValueError("kintree_table has a joint before its parent")
    faces = checked_array(arrays, "f", (None, 3), np.int64)
    if faces.size == 0 or faces.min() < 0 or faces.max() >= vertices:
        raise ValueError("f has vertices that do not exist")
    has_hands = all(mean in arrays for mean in _HAND_MEANS) and joints >= len(SMPLH)
    hands = [checked_array(arrays, mean, (len(_HANDS) // 2 * 3,), np.float64) for mean in _HAND_MEANS if has_hands]
    return BodyModel(
        path,
        name,
        template,
        shapes[:, :, :split],
        shapes[:, :, split:],
        np.ascontiguousarray(np.moveaxis(offsets, 2, 0)),
        checked_array(arrays, "J_regressor", (joints, vertices), np.float64),
        weights,
        (None, *tree[1:]),
        read_only_view(faces.astype(np.int32)),
        np.concatenate([np.zeros(0), *hands]).reshape(-1, 3),
    )


def _padded(name: str, given: npt.ArrayLike | None, directions: Doubles) -> Doubles:
    """Returns coefficients of all directions: those given, then zeros."""
    values = finite_array(name, () if given is None else given, np.float64)
    count = directions.shape[2]
    if values.ndim != 1 or values.size > count:
        raise SceneError(f"{name} has shape {values.shape}, expected at most {count} numbers, as the model has")
    return np.concatenate([values, np.zeros(count - values.size)])


def _vertex_normals(positions: Doubles, faces: IntArray) -> npt.NDArray[np.float32]:
    """Returns unit normals of the V vertices, means of their triangles' normals by area, shape (V, 3); 0 where none."""
    a, b, c = positions[faces].swapaxes(0, 1)
    normals = np.zeros_like(positions)
    for corner in faces.T:
        np.add.at(normals, corner, np.cross(b - a, c - a))
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0).astype(np.float32)
