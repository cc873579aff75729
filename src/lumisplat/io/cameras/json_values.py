"""Values of JSON camera files: checked numbers, and poses that must be rigid. Errors complete "frame 3 ..."."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import finite_numbers

Entry = Mapping[str, Any]
"""A JSON object."""
Matrix = npt.NDArray[np.float64]


def is_list(value: object) -> TypeGuard[list[object]]:
    """Whether a JSON value is an array."""
    return isinstance(value, list)


def is_object(value: object) -> TypeGuard[dict[str, Any]]:
    """Whether a JSON value is an object."""
    return isinstance(value, dict)


def quote(value: object) -> str:
    """JSON for a message, cut short."""
    text = json.dumps(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def number(values: Entry, name: str) -> float:
    """The number called ``name``.

    Raises:
        SceneError: It is not a number.
    """
    value = values[name]
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise SceneError(f"has {name} {quote(value)}, expected a number")
    return value


def number_array(values: object, shape: tuple[int, ...], name: str) -> Matrix:
    """Finite numbers in an array of the given shape.

    Raises:
        SceneError: The values are not as many finite numbers.
    """
    array = finite_numbers(values, shape)
    if array is None:
        raise SceneError(f"has {name} {quote(values)}, expected {' x '.join(map(str, shape))} finite numbers")
    return array


def rigid_pose(matrix: Matrix) -> Matrix:
    """A pose, shape (3 or 4, 4), as a rigid transform, shape (4, 4), with rounding errors of its rotation removed.

    Raises:
        SceneError: The matrix is singular, scaled, sheared or mirrored.
    """
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, (0.0, 0.0, 0.0, 1.0)])
    u, singular_values, v = np.linalg.svd(matrix[:3, :3])
    if singular_values[2] <= 1e-9 * singular_values[0]:
        raise SceneError("has a singular pose matrix")
    if np.ptp(singular_values) > 1e-3 * singular_values[0]:
        raise SceneError("has a pose that shears or stretches, expected a rotation and a translation")
    if abs(singular_values[0] - 1.0) > 1e-3:
        raise SceneError(f"has a pose scaled by {singular_values[0]:.6g}, expected a rotation and a translation")
    if np.linalg.det(matrix[:3, :3]) < 0.0:
        raise SceneError("has a pose that mirrors, expected a rotation and a translation")
    if np.abs(singular_values - 1.0).max() > 1e-12:
        matrix[:3, :3] = u @ v
    return matrix


def inverse_rigid(matrix: Matrix) -> Matrix:
    """The inverse of a rigid transform, shape (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse
