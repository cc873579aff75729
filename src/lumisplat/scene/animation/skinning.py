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
