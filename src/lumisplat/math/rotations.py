"""Rotations as quaternions and as matrices, of many things at once. Quaternions are wxyz: the scalar comes first."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, host_array, unit_vector

_Floats = npt.NDArray[np.floating]


def rotation_matrix(wxyz: npt.ArrayLike) -> Doubles:
    """The rotation matrix of one quaternion of any length above 0, shape (3, 3) from (4,).

    Raises:
        SceneError: The quaternion has zero length, or is not finite.
    """
    quaternion = np.asarray(host_array(wxyz), dtype=np.float64)
    if not 0.0 < quaternion @ quaternion < np.inf:
        raise SceneError("a rotation of zero length or not finite, expected a unit quaternion")
    return matrices_from_quaternions(quaternion[None])[0]


def rotation_from_degrees(angles: npt.NDArray[np.floating]) -> Doubles:
    """The matrix that turns about the fixed x axis, then y, then z, by angles in degrees, right-handed, shape (3,)."""
    x, y, z = np.radians(np.asarray(angles, dtype=np.float64))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def matrices_from_quaternions(wxyz: _Floats) -> Doubles:
    """Rotation matrices, shape (N, 3, 3), of quaternions of any length above 0, shape (N, 4)."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64).T
    scaled = np.array(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return np.moveaxis(scaled / (w * w + x * x + y * y + z * z), 2, 0)


def quaternions_from_matrices(matrices: _Floats) -> _Floats:
    """Unit quaternions of rotation matrices, shape (N, 4) from (N, 3, 3).

    There are four formulas (Shepperd 1978); each matrix uses the one with the largest divisor.
    """
    m = matrices
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    yz, xz, xy = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    yz_sum, xz_sum, xy_sum = m[:, 2, 1] + m[:, 1, 2], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 0] + m[:, 0, 1]
    ways = np.stack(
        [
            np.stack([1.0 + xx + yy + zz, yz, xz, xy], axis=1),
            np.stack([yz, 1.0 + xx - yy - zz, xy_sum, xz_sum], axis=1),
            np.stack([xz, xy_sum, 1.0 - xx + yy - zz, yz_sum], axis=1),
            np.stack([xy, xz_sum, yz_sum, 1.0 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    best = np.argmax(np.diagonal(ways, axis1=1, axis2=2), axis=1)
    largest = ways[np.arange(best.size), best]
    return largest / np.linalg.norm(largest, axis=1, keepdims=True)


def multiply_quaternions(left: _Floats, right: _Floats) -> _Floats:
    """Hamilton's product of one quaternion, shape (4,), with each of N, shape (N, 4): ``right`` turns first."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ matrix.T


def slerp(first: _Floats, second: _Floats, share: float) -> Doubles:
    """Interpolates between two unit quaternions along the shorter arc (Shoemake 1985).

    Args:
        first: Unit quaternion, shape (4,).
        second: Unit quaternion, shape (4,). Its negative is the same rotation; the nearer of the two is used.
        share: 0 gives ``first``, 1 gives ``second``.

    Returns:
        Unit quaternion, shape (4,).
    """
    cosine = float(first @ second)
    target, cosine = (second, cosine) if cosine >= 0.0 else (-second, -cosine)
    # From the half chord, because the cosine of a small angle has lost half of its digits.
    angle = 2.0 * np.arctan2(np.linalg.norm(first - target), np.linalg.norm(first + target))
    if angle < 1e-6:  # sin(x) = x here
        blend = (1.0 - share) * first + share * target
    else:
        blend = (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * target) / np.sin(angle)
    return blend / np.linalg.norm(blend)


def axis_rotation(axis: npt.ArrayLike, angle: float) -> Doubles:
    """The rotation about a unit axis, shape (3,), by an angle in radians, counter-clockwise seen against it, (3, 3)."""
    x, y, z = np.sin(0.5 * angle) * np.asarray(axis, dtype=np.float64)
    return rotation_matrix((np.cos(0.5 * angle), x, y, z))


def rotation_between(start: Doubles, end: Doubles) -> Doubles:
    """Returns the smallest rotation that turns one unit vector to another, shape (3, 3)."""
    axis, cosine = np.asarray(np.cross(start, end), np.float64), float(start @ end)
    if np.linalg.norm(axis) < 1e-12:
        if cosine > 0.0:
            return np.eye(3)
        axis = np.asarray(np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))]), np.float64)
    return axis_rotation(unit_vector(axis), math.atan2(float(np.linalg.norm(np.cross(start, end))), cosine))
