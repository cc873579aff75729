"""Spherical harmonics of what Gaussians show: weighted least squares, one small system each.

The equations are in docs/method/relighting.md#baking.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.constants.baking import RIDGE, SIGNAL_MIN
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.sh import sh_basis


def fit_sh(directions: Doubles, colors: Doubles, noise: Doubles, weights: Doubles, degree: int) -> FloatArray:
    """The harmonics whose colours ``SH + 0.5`` are nearest to those that were seen.

    Args:
        directions: From the eye to the Gaussian, in its own space, unit, shape (N, D, 3).
        colors: Display-referred, shape (N, D, 3).
        noise: Variance of these, shape (N,).
        weights: Of the views, at least 0, shape (N, D).
        degree: 0 to 3.

    Returns:
        Coefficients, shape (N, K, 3), K = (degree + 1)^2.
    """
    basis = sh_basis(directions, degree)
    shares = weights / weights.sum(axis=1, keepdims=True)
    weighted = shares[..., None] * basis
    matrix = 4.0 * np.pi * np.swapaxes(weighted, 1, 2) @ basis
    right = 4.0 * np.pi * np.swapaxes(weighted, 1, 2) @ (colors - 0.5)
    matrix += _penalties(colors, noise, shares, degree)[:, :, None] * np.eye(basis.shape[2])
    return np.linalg.solve(matrix, right).astype(np.float32)


def constant_sh(colors: npt.NDArray[np.floating], degree: int) -> FloatArray:
    """The harmonics of colours that are the same from everywhere, shape (N, 3) to (N, K, 3)."""
    sh = np.zeros((len(colors), (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (colors - 0.5) / SH_C0
    return sh


def _penalties(colors: Doubles, noise: Doubles, shares: Doubles, degree: int) -> Doubles:
    """What is added to the diagonal of each system, shape (N, K).

    As much as the noise of a coefficient is of the variance that is to be expected of it (Wiener): what colours vary
    with the direction but for noise, shared among the degrees as 1 / l^2. And a little, so that all is determined.
    """
    mean = np.einsum("nd,ndc->nc", shares, colors)
    spread = np.einsum("nd,ndc->n", shares, np.square(colors - mean[:, None])) / 3.0
    signal = np.maximum(spread - noise, SIGNAL_MIN)
    ratio = noise * np.square(shares).sum(axis=1) / signal
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    even = sum((2 * l + 1) / l**2 for l in range(1, degree + 1))
    return ratio[:, None] * (even * level**2) + RIDGE * np.square(level * (level + 1.0))
