"""Linear blend skinning: a vertex moves with the weighted mean of its joints' matrices (glTF 2.0 section 3.7.3)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.floating]


def blend_matrices(matrices: _Floats, joints: npt.NDArray[np.integer], weights: _Floats) -> npt.NDArray[np.float64]:
    """The skinning matrix of each vertex, shape (V, 3, 4).

    Args:
        matrices: ``world_from_bind`` of each joint: its pose times its inverse bind matrix, shape (J, 4, 4).
        joints: Indices of the joints of each vertex, shape (V, K).
        weights: Weights of these joints, of any sum but 0, shape (V, K).
    """
    rows = np.ascontiguousarray(matrices[:, :3])
    blended = np.zeros((len(joints), 3, 4))
    for k in range(joints.shape[1]):
        used = np.flatnonzero(weights[:, k])
        blended[used] += weights[used, k, None, None] * rows[joints[used, k]]
    return blended / weights.sum(axis=1, dtype=np.float64)[:, None, None]
