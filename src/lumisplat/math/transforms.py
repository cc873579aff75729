"""Rotations, rigid motions and their twists (Blanco 2010, sections 7 and 10), and affine transforms of points.

Quaternions are wxyz: the scalar comes first.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, host_array, unit_vector

_Floats = npt.NDArray[np.floating]


def rotation_matrix(wxyz: npt.ArrayLike) -> Doubles:
    """Returns the rotation matrix, shape (3, 3), of one quaternion, shape (4,), of any length above 0.

    Raises:
        SceneError: The quaternion has zero length, or is not finite.
    """
    quaternion = np.asarray(host_array(wxyz), dtype=np.float64)
    if not 0.0 < quaternion @ quaternion < np.inf:
        raise SceneError("a rotation of zero length or not finite, expected a unit quaternion (w, x, y, z)")
    return matrices_from_quaternions(quaternion[None])[0]


def rotation_from_degrees(angles: npt.NDArray[np.floating]) -> Doubles:
    """Returns the right-handed rotation about the fixed x, then y, then z axis, by three angles in degrees."""
    x, y, z = np.radians(np.asarray(angles, dtype=np.float64))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def matrices_from_quaternions(wxyz: _Floats) -> Doubles:
    """Returns the rotation matrices, shape (N, 3, 3), of N quaternions of any length above 0, shape (N, 4)."""
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
    """Returns the unit quaternions, shape (N, 4), of N rotation matrices, shape (N, 3, 3).

    There are four formulas (Shepperd 1978); each matrix uses the one with the largest divisor.
    """
    m = matrices
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    yz, xz, xy = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    yz_sum, xz_sum, xy_sum = m[:, 2, 1] + m[:, 1, 2], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 0] + m[:, 0, 1]
    candidates = np.stack(
        [
            np.stack([1.0 + xx + yy + zz, yz, xz, xy], axis=1),
            np.stack([yz, 1.0 + xx - yy - zz, xy_sum, xz_sum], axis=1),
            np.stack([xz, xy_sum, 1.0 - xx + yy - zz, yz_sum], axis=1),
            np.stack([xy, xz_sum, yz_sum, 1.0 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    best = np.argmax(np.diagonal(candidates, axis1=1, axis2=2), axis=1)
    largest = candidates[np.arange(best.size), best]
    return largest / np.linalg.norm(largest, axis=1, keepdims=True)


def quaternions_from_rotation_vectors(vectors: _Floats) -> Doubles:
    """Returns unit quaternions, shape (..., 4), of rotation vectors (axis times angle in radians), shape (..., 3)."""
    half = 0.5 * np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors], axis=-1)


def multiply_quaternions(left: _Floats, right: _Floats) -> _Floats:
    """Returns the Hamilton products ``left right`` of one quaternion, (4,), with N others, (N, 4).

    The product is the rotation by ``right``, then by ``left``.
    """
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ matrix.T


def slerp(first: _Floats, second: _Floats, share: float) -> Doubles:
    """Interpolates between two unit quaternions along the shorter arc (Shoemake 1985).

    Args:
        first: Unit quaternion, shape (4,).
        second: Unit quaternion, shape (4,). Its negative is the same rotation; the nearer of the two is used.
        share: Interpolation parameter: 0 gives ``first``, 1 gives ``second``.

    Returns:
        Unit quaternion, shape (4,).
    """
    cosine = float(first @ second)
    target, cosine = (second, cosine) if cosine >= 0.0 else (-second, -cosine)
    # The angle comes from half chords, because the cosine of a small angle loses half of its digits.
    angle = 2.0 * np.arctan2(np.linalg.norm(first - target), np.linalg.norm(first + target))
    if angle < 1e-6:  # sin(x) = x here
        blend = (1.0 - share) * first + share * target
    else:
        blend = (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * target) / np.sin(angle)
    return blend / np.linalg.norm(blend)


def axis_rotation(axis: npt.ArrayLike, angle: float) -> Doubles:
    """Returns the right-handed rotation matrix, (3, 3), about a unit axis, (3,), by an angle in radians."""
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


_SMALL = 1e-4
"""Rotation angle in radians below which power series replace quotients such as sin(a) / a, which would lose digits."""


def cross_matrix(v: npt.ArrayLike) -> Doubles:
    """Returns the matrix of the cross product with ``v``, shape (3, 3)."""
    x, y, z = np.asarray(v, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rigid_from_twist(twist: npt.ArrayLike) -> Doubles:
    """Returns the rigid motion that a twist generates in unit time, shape (4, 4).

    Args:
        twist: Rotation vector in radians, then velocity, shape (6,).
    """
    rotation_vector, velocity = np.split(np.asarray(twist, np.float64), 2)
    cross, angle = cross_matrix(rotation_vector), float(np.linalg.norm(rotation_vector))
    first, second, third = _series(angle)
    motion = np.eye(4)
    motion[:3, :3] += first * cross + second * cross @ cross
    motion[:3, 3] = velocity + second * cross @ velocity + third * cross @ cross @ velocity
    return motion


def twist_from_rigid(motion: npt.ArrayLike) -> Doubles:
    """Returns the twist, shape (6,), of a rigid motion that rotates by less than 180 degrees."""
    motion = np.asarray(motion, np.float64)
    rotation, offset = motion[:3, :3], motion[:3, 3]
    skew = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    angle = math.atan2(float(np.linalg.norm(skew)), 0.5 * (float(np.trace(rotation)) - 1.0))
    first, second, third = _series(angle)
    rotation_vector = skew / first
    cross = cross_matrix(rotation_vector)
    of_velocity = np.eye(3) + second * cross + third * cross @ cross
    return np.asarray(np.concatenate([rotation_vector, np.linalg.solve(of_velocity, offset)]), np.float64)


def _series(angle: float) -> tuple[float, float, float]:
    """Returns ``sin a / a``, ``(1 - cos a) / a^2`` and ``(a - sin a) / a^3`` for the angle a in radians."""
    square = angle * angle
    if angle < _SMALL:
        return 1.0 - square / 6.0, 0.5 - square / 24.0, (1.0 - square / 20.0) / 6.0
    return math.sin(angle) / angle, (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)


def transform_points(matrix: Doubles, points: _Floats) -> Doubles:
    """Transforms V points, shape (V, 3), by one affine transform of 3 or 4 rows, shape (3 or 4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def transform_points_each(matrices: _Floats, points: _Floats) -> Doubles:
    """Transforms V points, shape (V, 3), each by its own affine transform, or all by a single one.

    V transforms have shape (V, 3 or 4, 4), a single one (1, 3 or 4, 4).
    """
    return (matrices[:, :3, :3] @ points[:, :, None])[:, :, 0] + matrices[:, :3, 3]


def transform_normals_each(matrices: _Floats, normals: _Floats) -> Doubles:
    """Transforms V normals, shape (V, 3), each by its own affine transform, or all by a single one.

    V transforms have shape (V, 3 or 4, 4), a single one (1, 3 or 4, 4). The returned normals have any length.
    """
    # Cofactors transform normals as the inverse transpose does, up to length, and exist for singular matrices too.
    # Where a matrix mirrors, the cofactors flip the normal.
    a, b, c = matrices[:, :3, 0], matrices[:, :3, 1], matrices[:, :3, 2]
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
    signs = np.where(np.einsum("vi,vi->v", a, cofactors[:, :, 0]) < 0.0, -1.0, 1.0)
    return signs[:, None] * (cofactors @ normals[:, :, None])[:, :, 0]


def is_mirroring(matrices: _Floats) -> bool:
    """Returns whether most of the matrices mirror (negative determinant), which reverses the winding of triangles."""
    return bool(np.median(np.linalg.det(matrices[:, :3, :3])) < 0.0)
