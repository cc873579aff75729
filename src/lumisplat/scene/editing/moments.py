"""Mass, mean and covariance of Gaussians, and of mixtures of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import DECIMATE_OPACITY_MIN, SCALE_MIN
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.gaussians import Gaussians

ROWS, COLUMNS = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Where the six entries of a packed symmetric matrix stand."""


class Moments(NamedTuple):
    """Moments of N Gaussians, an array for each axis or entry, so that each is contiguous."""

    masses: Doubles
    """Opacity times `areas`, above 0, shape (N,)."""
    means: Doubles
    """Shape (3, N)."""
    covariances: Doubles
    """Packed, shape (6, N)."""

    def at(self, rows: npt.NDArray[np.intp] | slice) -> Moments:
        """Some of them."""
        return Moments(self.masses[rows], self.means[:, rows], self.covariances[:, rows])


def moments_of(gaussians: Gaussians) -> Moments:
    """The moments of each Gaussian of a capture."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :].astype(np.float64)
    matrices = axes @ axes.transpose(0, 2, 1)
    covariances = np.ascontiguousarray(matrices[:, ROWS, COLUMNS].T)
    # Invisible ones have some mass, too: they have a position.
    opacities = np.maximum(gaussians.opacities.astype(np.float64), DECIMATE_OPACITY_MIN)
    return Moments(opacities * areas(covariances), np.ascontiguousarray(gaussians.means.T, np.float64), covariances)


def areas(covariances: Doubles) -> Doubles:
    """The area that a Gaussian covers, up to a constant: the root mean square over all directions, shape (N,).

    Seen along a unit vector n, its outline has the area pi sqrt(n^T adj(covariance) n), whose square has a third of the
    adjugate's trace as its mean.
    """
    xx, xy, xz, yy, yz, zz = covariances
    trace = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    return np.sqrt(np.maximum(trace, SCALE_MIN**4))


def log_determinants(covariances: Doubles) -> Doubles:
    """Natural logarithms of the determinants, shape (N,)."""
    xx, xy, xz, yy, yz, zz = covariances
    determinants = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    # Rounding may leave nothing, or less, of the thinnest.
    return np.log(np.maximum(determinants, 1e-15 * xx * yy * zz + SCALE_MIN**6))


def mixture(first: Moments, second: Moments) -> Moments:
    """The moments of the mixture of each Gaussian of ``first`` with one of ``second``."""
    masses = first.masses + second.masses
    share = second.masses / masses
    step = second.means - first.means
    covariances = first.covariances + share * (second.covariances - first.covariances)
    spread = share * (1.0 - share)
    for entry in range(6):
        covariances[entry] += spread * step[ROWS[entry]] * step[COLUMNS[entry]]
    return Moments(masses, first.means + share * step, covariances)


def mixtures(parts: Moments, labels: npt.NDArray[np.intp], count: int) -> Moments:
    """The moments of ``count`` mixtures, to which the labels of the parts, shape (N,), assign them."""
    masses = np.bincount(labels, parts.masses, count).astype(np.float64, copy=False)

    def averages(values: Doubles) -> Doubles:
        return np.stack([np.bincount(labels, parts.masses * row, count) / masses for row in values])

    means = averages(parts.means)
    offsets = parts.means - means[:, labels]
    products = parts.covariances + offsets[list(ROWS)] * offsets[list(COLUMNS)]
    return Moments(masses, means, averages(products))


def shapes(covariances: Doubles) -> tuple[Doubles, Doubles]:
    """Unit quaternions, shape (N, 4), and scales, the smallest first, shape (N, 3), of covariances."""
    matrices = np.empty((covariances.shape[1], 3, 3))
    for entry in range(6):
        matrices[:, ROWS[entry], COLUMNS[entry]] = matrices[:, COLUMNS[entry], ROWS[entry]] = covariances[entry]
    variances, axes = np.linalg.eigh(matrices)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    # Rounding hides variances below 1e-16 of the largest.
    smallest = np.maximum(SCALE_MIN**2, 1e-15 * variances[:, 2:])
    return quaternions_from_matrices(axes).astype(np.float64), np.sqrt(np.maximum(variances, smallest))
