"""Where Gaussians are seen: points on them, and on which side."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

from lumisplat.constants.delight import (
    SIDE_ERROR,
    SIDE_SHARPNESS,
    SIDE_STEPS,
    SIDE_STIFFNESS,
    SURFACE_SPREAD,
)
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.sampling.blue_noise import Pairs


class SurfacePoints:
    """Random points on Gaussians, where rays that come along their normals see them.

    Args:
        gaussians: The set.
        seed: Of the points.
    """

    def __init__(self, gaussians: Gaussians, seed: int) -> None:
        self._means, self._scales = gaussians.means.astype(np.float64), gaussians.scales.astype(np.float64)
        self._axes = matrices_from_quaternions(gaussians.rotations_wxyz)
        self._rng = np.random.default_rng([seed, 9])

    def at(self, rows: Rows, normals: Doubles) -> FloatArray:
        """One point on each of some Gaussians: the peak of its response along a line, shape (R, 3)."""
        point = SURFACE_SPREAD * self._rng.standard_normal((len(rows), 3))
        slope = np.einsum("ijk,ij->ik", self._axes[rows], normals) / self._scales[rows]
        along = np.einsum("ij,ij->i", point, slope) / np.einsum("ij,ij->i", slope, slope)
        peak = self._scales[rows] * (point - along[:, None] * slope)
        return (self._means[rows] + np.einsum("ijk,ik->ij", self._axes[rows], peak)).astype(np.float32)


def agreed_sides(axes: Doubles, votes: Doubles, near: Pairs) -> Doubles:
    """Signs of axes: as Gaussians vote, and where they are unsure, as neighbours that lie alike do, shape (N,).

    The minimum of ``sum c_i (s_i - sign v_i)^2 + sum w_ij (s_i - sign(a_i a_j) s_j)^2 / 2``, where ``c_i = |v_i|``, by
    conjugate gradients: votes spread along surfaces however far away the next sure one is.

    Args:
        axes: Unit, of either sign, shape (N, 3).
        votes: Above 0: along the axis; farther from 0: surer; shape (N,).
        near: Pairs of neighbours, in both orders.
    """
    count = len(axes)
    cosines = np.einsum("ij,ij->i", axes[near.first], axes[near.second])
    weights = SIDE_STIFFNESS * np.sign(cosines) * np.abs(cosines) ** SIDE_SHARPNESS
    weights[near.first == near.second] = 0.0
    diagonal = np.abs(votes) + np.bincount(near.first, np.abs(weights), count) + 1e-9
    matrix = diags_array(diagonal) - csr_array((weights, (near.first, near.second)), (count, count))
    tolerance, jacobi = SIDE_ERROR * np.sqrt(count), diags_array(1.0 / diagonal)
    signs, _ = cg(matrix, votes, np.sign(votes), rtol=0.0, atol=tolerance, maxiter=SIDE_STEPS, M=jacobi)
    return np.where(signs >= 0.0, 1.0, -1.0)
