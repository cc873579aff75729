"""Rotations of many things at once: quaternions to matrices and back, and the shortest way between two of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError

_Floats = npt.NDArray[np.floating]


def rotation_matrix(wxyz: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """The matrix of a quaternion of any length but zero, scalar first, shape (3, 3).

    Raises:
        SceneError: It has zero length, or is not finite.
    """
    w, x, y, z = np.asarray(wxyz, dtype=np.float64)
    length2 = w * w + x * x + y * y + z * z
    if not 0.0 < length2 < np.inf:
        raise SceneError("a rotation of zero length or not finite, expected a unit quaternion")
    scaled = np.array(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
    return scaled / length2


def matrices_from_quaternions(wxyz: _Floats) -> npt.NDArray[np.float64]:
    """Rotation matrices, shape (N, 3, 3), of unit quaternions, shape (N, 4), scalar first."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def quaternions_from_matrices(matrices: _Floats) -> _Floats:
    """Unit quaternions wxyz of rotation matrices, shape (N, 4) from (N, 3, 3).

    Of the four ways to write one (Shepperd 1978), each row takes the one with the largest divisor.
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
    picked = ways[np.arange(best.size), best]
    return picked / np.linalg.norm(picked, axis=1, keepdims=True)


def slerp(first: _Floats, second: _Floats, share: float) -> npt.NDArray[np.float64]:
    """The unit quaternion that far along the shorter arc (Shoemake 1985), shape (4,).

    Args:
        first: Unit quaternion, in any order of components, shape (4,).
        second: Likewise; its negative is the same rotation, and the nearer of the two is gone to.
        share: 0 gives ``first``, 1 ``second``.
    """
    cosine = float(first @ second)
    target, cosine = (second, cosine) if cosine >= 0.0 else (-second, -cosine)
    # The chord's half length knows small angles, of which the cosine has lost half the digits.
    angle = 2.0 * np.arctan2(np.linalg.norm(first - target), np.linalg.norm(first + target))
    if angle < 1e-6:  # sin(x) = x here
        blend = (1.0 - share) * first + share * target
    else:
        blend = (np.sin((1.0 - share) * angle) * first + np.sin(share * angle) * target) / np.sin(angle)
    return blend / np.linalg.norm(blend)
