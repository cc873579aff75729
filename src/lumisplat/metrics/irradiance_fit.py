"""Irradiance in spherical harmonics, fitted to the luminance and the normals of points.

``Y_i = alpha_i E(n_i; c)`` with a free scale for each point has no unique solution: any positive E fits exactly.
docs/adr/0015-lighting-metrics.md explains how c is chosen here, and why.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.metrics import (
    FIT_STEPS_MAX,
    FIT_TOLERANCE,
    HUBER_WIDTH,
    HUBER_WIDTH_MIN,
    IRRADIANCE_FLOOR,
    IRRADIANCE_SH_DEGREE,
    IRRADIANCE_SMOOTHNESS,
    MAD_PER_DEVIATION,
    TRIMMED_SHARE,
)
from lumisplat.errors import SceneError
from lumisplat.math.arrays import host_array
from lumisplat.math.sh import sh_basis

Values = npt.NDArray[np.float64]

COEFFICIENTS = (IRRADIANCE_SH_DEGREE + 1) ** 2
_BANDS = np.repeat(np.arange(IRRADIANCE_SH_DEGREE + 1), 2 * np.arange(IRRADIANCE_SH_DEGREE + 1) + 1)
"""The band l of each coefficient."""


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance as a function of the normal, and a scale for each point; the result of `fit_irradiance`."""

    coefficients: Values
    """c, real and orthonormal SH in the order of captures, shape (16,). The sum of their absolute values is 1."""
    scales: Values
    """alpha of each point, at least 0, shape (N,): luminance over irradiance."""

    def at(self, normals: npt.ArrayLike) -> Values:
        """E at unit normals of shape (N, 3)."""
        return _basis(normals) @ self.coefficients


def fit_irradiance(normals: npt.ArrayLike, luminance: npt.ArrayLike, name: str = "points") -> Irradiance:
    """Factorises ``Y_i = alpha_i E(n_i; c)``: c by a robust fit with all scales equal, then the scales.

    The fit minimises Huber's loss of the residuals ``alpha_i - 1``, without the 5 % of the points that fit worst. In
    directions without normals, irradiance stays smooth. Scales that are independent of the normals change c by a
    factor only, whatever their distribution.

    Args:
        normals: Unit normals, shape (N, 3).
        luminance: CIE Y, linear, at least 0, shape (N,).
        name: Name of the points in messages.

    Returns:
        c and the scales. The unit of luminance changes the scales by a factor, and c not at all.

    Raises:
        SceneError: There are fewer points than coefficients, or all are black.
    """
    values = np.asarray(host_array(luminance), np.float64)
    if values.size < COEFFICIENTS:
        raise SceneError(f"{values.size} {name}: irradiance of {COEFFICIENTS} coefficients needs as many at least")
    # The mean without the brightest points, as a few of those could dominate it.
    mean = float(np.sort(values)[: values.size - int(TRIMMED_SHARE * values.size)].mean())
    if not mean > 0.0:
        raise SceneError(f"all {values.size:,} {name} are black: they show nothing of the light")
    basis = _basis(normals)
    penalty = IRRADIANCE_SMOOTHNESS * _BANDS * (_BANDS + 1.0)
    fitted = robust_fit(basis, values / mean, penalty, relative_above=IRRADIANCE_FLOOR)
    total = float(np.abs(fitted).sum())
    coefficients = fitted / total
    irradiance = basis @ coefficients
    scales = np.divide(values, irradiance, out=np.zeros_like(values), where=irradiance > 0.0)
    return Irradiance(coefficients, np.maximum(scales, 0.0))


def robust_fit(
    design: Values, values: Values, penalty: Values | None = None, *, relative_above: float | None = None
) -> Values:
    """Coefficients x for which ``design @ x`` is close to ``values``: Huber's loss, without the 5 % that fit worst.

    Rows are left out once, by their residuals from Huber's fit to all rows. If they were chosen anew in every step, the
    remaining rows would be those that happen to agree with an early fit. Huber's width follows the median residual, so
    that the fit scales with the values.

    Args:
        design: Shape (N, K).
        values: Shape (N,).
        penalty: Weight of each squared coefficient against the mean over the rows, shape (K,); None: no penalty.
        relative_above: If given, residuals are relative to the fitted value or to this number, whichever is larger; for
            values that vary by factors. None: residuals are differences.

    Returns:
        Shape (K,); the smallest solution if there are several.
    """
    ridge = np.diag(np.zeros(int(design.shape[1])) if penalty is None else penalty)
    found = _huber_fit(
        design, values, ridge, relative_above, _weighted_fit(design, values, np.ones_like(values), ridge)
    )
    dropped = int(TRIMMED_SHARE * values.size)
    if not dropped:
        return found
    distance, _ = _residuals(design, values, found, relative_above)
    rows = np.sort(np.argpartition(distance, values.size - dropped)[: values.size - dropped])
    return _huber_fit(design[rows], values[rows], ridge, relative_above, found)


def _huber_fit(design: Values, values: Values, ridge: Values, relative_above: float | None, start: Values) -> Values:
    """Iteratively reweighted least squares."""
    found = start
    smallest = FIT_TOLERANCE * max(float(np.abs(values).max()), np.finfo(np.float64).tiny)
    if relative_above is not None:
        smallest = HUBER_WIDTH_MIN
    for _ in range(FIT_STEPS_MAX):
        distance, unit = _residuals(design, values, found, relative_above)
        width = max(HUBER_WIDTH * float(np.median(distance)) / MAD_PER_DEVIATION, smallest)
        weights = width / np.maximum(distance, width) / unit**2
        before, found = found, _weighted_fit(design, values, weights, ridge)
        if np.abs(found - before).max() <= FIT_TOLERANCE * np.abs(found).max():
            break
    return found


def _residuals(
    design: Values, values: Values, found: Values, relative_above: float | None
) -> tuple[Values, Values | float]:
    """Absolute residuals, and the unit in which each is measured."""
    fitted = design @ found
    unit = 1.0 if relative_above is None else np.maximum(fitted, relative_above)
    return np.abs(values - fitted) / unit, unit


def _weighted_fit(design: Values, values: Values, weights: Values, ridge: Values) -> Values:
    weighted = design * weights[:, None]
    # The penalty scales with the weights, so that the smoothness does not depend on the quality of the fit.
    matrix: Values = design.T @ weighted + weights.sum() * ridge
    right: Values = weighted.T @ values
    return np.linalg.lstsq(matrix, right)[0].astype(np.float64)


def _basis(normals: npt.ArrayLike) -> Values:
    return sh_basis(normals, IRRADIANCE_SH_DEGREE).astype(np.float64)
