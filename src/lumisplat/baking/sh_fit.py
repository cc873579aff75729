"""Spherical harmonics of what Gaussians show: weighted least squares, one small system each.

The equations are in docs/method/relighting.md#baking.
"""

from __future__ import annotations

from typing import cast

import numpy as np

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
    sh = cast("Doubles", np.linalg.solve(matrix, right))
    return sh.astype(np.float32)


def _penalties(colors: Doubles, noise: Doubles, shares: Doubles, degree: int) -> Doubles:
    """What is added to the diagonal of each system, shape (N, K).

    As much as the noise of a coefficient is of the variance that is to be expected of it (Wiener): what colours vary
    with the direction but for noise, shared among the degrees as 1 / l^2. And a little, so that all is determined.
    """
    mean = (shares[..., None] * colors).sum(axis=1, keepdims=True)
    spread = (shares * np.square(colors - mean).mean(axis=2)).sum(axis=1)
    signal = np.maximum(spread - noise, SIGNAL_MIN)
    ratio = noise * np.square(shares).sum(axis=1) / signal
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    even = sum((2 * one + 1) / one**2 for one in range(1, degree + 1))
    return ratio[:, None] * (even * level**2) + RIDGE * np.square(level * (level + 1.0))
