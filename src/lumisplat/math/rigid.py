"""Rigid motions and their twists: SE(3) and its tangent space at the identity (Blanco 2010, sections 7 and 10)."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles

_SMALL = 1e-4
"""Angle, radians, below which series replace quotients that lose digits."""


def cross_matrix(v: npt.ArrayLike) -> Doubles:
    """The matrix that takes the cross product with ``v``, shape (3, 3)."""
    x, y, z = np.asarray(v, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rigid_from_twist(twist: npt.ArrayLike) -> Doubles:
    """The motion that a twist becomes in unit time, shape (4, 4).

    Args:
        twist: A turn as a vector, radians, then a velocity, shape (6,).
    """
    turn, velocity = np.split(np.asarray(twist, np.float64), 2)
    cross, angle = cross_matrix(turn), float(np.linalg.norm(turn))
    first, second, third = _series(angle)
    motion = np.eye(4)
    motion[:3, :3] += first * cross + second * cross @ cross
    motion[:3, 3] = velocity + second * cross @ velocity + third * cross @ cross @ velocity
    return motion


def twist_from_rigid(motion: npt.ArrayLike) -> Doubles:
    """The twist of a motion by less than half a turn, shape (6,): the inverse of ``rigid_from_twist``."""
    motion = np.asarray(motion, np.float64)
    rotation, offset = motion[:3, :3], motion[:3, 3]
    skew = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    angle = math.atan2(float(np.linalg.norm(skew)), 0.5 * (float(np.trace(rotation)) - 1.0))
    first, second, third = _series(angle)
    turn = skew / first
    cross = cross_matrix(turn)
    of_velocity = np.eye(3) + second * cross + third * cross @ cross
    return np.asarray(np.concatenate([turn, np.linalg.solve(of_velocity, offset)]), np.float64)


def _series(angle: float) -> tuple[float, float, float]:
    """``sin a / a``, ``(1 - cos a) / a^2`` and ``(a - sin a) / a^3``."""
    square = angle * angle
    if angle < _SMALL:
        return 1.0 - square / 6.0, 0.5 - square / 24.0, (1.0 - square / 20.0) / 6.0
    return math.sin(angle) / angle, (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
