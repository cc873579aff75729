"""Body models in float64, vertex by vertex, as in the equations of Loper et al. 2015."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def rodrigues(vector: np.ndarray) -> np.ndarray:
    """Returns the rotation matrix of a rotation vector (equation 1)."""
    angle = math.sqrt(sum(float(x) ** 2 for x in vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew


def posed_body(arrays: dict[str, Any], coefficients: np.ndarray, pose: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Returns the vertices of a body, shape (V, 3).

    Args:
        arrays: Arrays of the model file.
        coefficients: One for each column of ``shapedirs``.
        pose: Rotation vectors of the joints, shape (J, 3).
        moved: Translation, shape (3,).
    """
    parents = [int(parent) for parent in arrays["kintree_table"][0].astype(np.int64)]
    count, vertices = len(parents), len(arrays["v_template"])
    shaped = np.array([arrays["v_template"][v] + arrays["shapedirs"][v] @ coefficients for v in range(vertices)])  # 8
    joints = np.array([sum(arrays["J_regressor"][j, v] * shaped[v] for v in range(vertices)) for j in range(count)])
    rotations = [rodrigues(vector) for vector in pose]
    entries = [rotations[j][row, column] - float(row == column) for j in range(1, count) for row in range(3)
               for column in range(3)]  # fmt: skip
    corrected = [shaped[v] + arrays["posedirs"][v] @ np.array(entries) for v in range(vertices)]  # equation 9
    globals_: list[np.ndarray] = []  # equation 4
    for j in range(count):
        matrix = np.eye(4)
        matrix[:3, :3] = rotations[j]
        matrix[:3, 3] = joints[j] - joints[parents[j]] if j else joints[0]
        globals_.append(globals_[parents[j]] @ matrix if j else matrix)
    result = np.zeros((vertices, 3))
    for v in range(vertices):
        for j in range(count):  # equations 2 and 3
            weight = arrays["weights"][v, j]
            if weight:
                result[v] += weight * (globals_[j][:3, :3] @ (corrected[v] - joints[j]) + globals_[j][:3, 3])
    return result + moved
