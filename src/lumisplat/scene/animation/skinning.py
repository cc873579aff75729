"""Linear blend skinning: every vertex follows the weighted mean of its joints' matrices (glTF 2.0 section 3.7.3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.floating]


def blended(matrices: _Floats, joints: npt.NDArray[np.integer], weights: _Floats) -> npt.NDArray[np.float64]:
    """The matrix of each vertex, shape (V, 3, 4).

    Args:
        matrices: ``world_from_bind`` of each joint: its pose times its inverse bind matrix, shape (J, 4, 4).
        joints: Joints of each vertex, shape (V, K).
        weights: Theirs, of any sum but 0, shape (V, K).
    """
    rows = np.ascontiguousarray(matrices[:, :3])
    mixed = np.zeros((len(joints), 3, 4))
    for k in range(joints.shape[1]):
        used = np.flatnonzero(weights[:, k])
        mixed[used] += weights[used, k, None, None] * rows[joints[used, k]]
    return mixed / weights.sum(axis=1, dtype=np.float64)[:, None, None]


def moved_points(matrices: _Floats, points: _Floats) -> npt.NDArray[np.float64]:
    """Points, shape (V, 3), by a matrix each, or all by one: shape (V or 1, 3 or 4, 4)."""
    return (matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3]


def moved_normals(matrices: _Floats, normals: _Floats) -> npt.NDArray[np.float64]:
    """Normals, shape (V, 3), by a matrix each, or all by one, to any length."""
    # Cofactors carry normals as the inverse transpose does, up to length, and exist for a singular matrix too; where a
    # matrix mirrors they point the other way.
    a, b, c = matrices[:, :3, 0], matrices[:, :3, 1], matrices[:, :3, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    signs = np.where(np.einsum("vi,vi->v", a, cofactors[:, :, 0]) < 0.0, -1.0, 1.0)
    return signs[:, None] * (cofactors @ normals[:, :, None])[:, :, 0]


def mirrors(matrices: _Floats) -> bool:
    """Whether most matrices mirror, so that triangles face the other way."""
    return bool(np.median(np.linalg.det(matrices[:, :3, :3])) < 0.0)
