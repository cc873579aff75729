"""Rigid motions and their twists."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm, logm

from lumisplat.math.transforms import cross_matrix, rigid_from_twist, twist_from_rigid


def generator(twist: np.ndarray) -> np.ndarray:
    """Returns the matrix whose exponential is the rigid motion of a twist."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = cross_matrix(twist[:3]), twist[3:]
    return matrix


@pytest.mark.parametrize("size", [0.0, 1e-9, 9e-5, 1.1e-4, 0.1, 1.5])
def test_rigid_motions_are_matrix_exponentials_of_twists(size: float) -> None:
    """Small and large motions match SciPy's matrix exponential and logarithm."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        twist = size * rng.uniform(-1.0, 1.0, 6)
        motion = rigid_from_twist(twist)
        np.testing.assert_allclose(motion, expm(generator(twist)), atol=1e-13)
        np.testing.assert_allclose(twist_from_rigid(motion), twist, atol=1e-12)
        if size > 0.01:
            np.testing.assert_allclose(generator(twist_from_rigid(motion)), np.real(logm(motion)), atol=1e-10)


def test_axis_rotation_matrix_is_right_handed() -> None:
    """A right angle about z rotates x to y."""
    motion = rigid_from_twist([0.0, 0.0, np.pi / 2.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(motion @ [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], atol=1e-15)
