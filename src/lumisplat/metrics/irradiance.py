"""The light that a cloud of points tells of: irradiance in spherical harmonics, fitted to luminance over normals.

``Y_i = alpha_i E(n_i; c)`` with a scale of its own for each point says nothing as it stands: any positive E fits
exactly. docs/adr/0015-lighting-metrics.md has how c is chosen here, and why.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants import (
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
from lumisplat.scene.ops.sh_colors import sh_basis

Values = npt.NDArray[np.float64]

COEFFICIENTS = (IRRADIANCE_SH_DEGREE + 1) ** 2
_BANDS = np.repeat(np.arange(IRRADIANCE_SH_DEGREE + 1), 2 * np.arange(IRRADIANCE_SH_DEGREE + 1) + 1)
"""The band l of each coefficient."""


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """What `fit_irradiance` finds."""

    coefficients: Values
    """c, real and orthonormal SH in the order of captures, shape (16,). The sum of their absolute values is 1."""
    scales: Values
    """alpha of each point, at least 0, shape (N,): luminance over irradiance."""

    def at(self, normals: npt.ArrayLike) -> Values:
        """E at unit normals of shape (N, 3)."""
        return _basis(normals) @ self.coefficients


def fit_irradiance(normals: npt.ArrayLike, luminance: npt.ArrayLike, name: str = "points") -> Irradiance:
    """Factorises ``Y_i = alpha_i E(n_i; c)``: c by a robust fit with all scales equal, then the scales.

    The fit is Huber's, of residuals ``alpha_i - 1``, without the 5 % of the points that fit worst; where no normals
    look, irradiance stays smooth. Scales that do not go with normals, however they are distributed, change c by a
    factor only.

    Args:
        normals: Unit normals, shape (N, 3).
        luminance: CIE Y, linear, at least 0, shape (N,).
        name: What the points are, for messages.

    Returns:
        c and the scales. Neither depends on the unit of luminance, but for a factor of the scales.

    Raises:
        SceneError: There are fewer points than coefficients, or all are black.
    """
    values = np.asarray(luminance, np.float64)
    if values.size < COEFFICIENTS:
        raise SceneError(f"{values.size} {name}: irradiance of {COEFFICIENTS} coefficients needs as many at least")
    # Of all but the brightest, a few of which could make up any mean.
    mean = float(np.sort(values)[: values.size - int(TRIMMED_SHARE * values.size)].mean())
    if not mean > 0.0:
        raise SceneError(f"all {values.size:,} {name} are black: they tell nothing of the light")
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
    """Coefficients x for which ``design @ x`` is near ``values``: Huber's loss, without the 5 % that fit worst.

    Rows are left out once, by their residuals from Huber's fit to all of them: left out anew in each step, those that
    stay would be the ones that agree with where the fit went by chance. Huber's width follows the median residual, so
    that the fit of values c times as large is c times as large.

    Args:
        design: Shape (N, K).
        values: Shape (N,).
        penalty: Weight of each squared coefficient against the mean over the rows, shape (K,); None: none has one.
        relative_above: Residuals are shares of what is fitted, where that is above this: for values that vary by
            factors. None: they are differences.

    Returns:
        Shape (K,); of several as good the smallest.
    """
    ridge = np.diag(np.zeros(design.shape[1]) if penalty is None else penalty)
    found = _huber_fit(
        design, values, ridge, relative_above, _weighted_fit(design, values, np.ones_like(values), ridge)
    )
    dropped = int(TRIMMED_SHARE * values.size)
    if not dropped:
        return found
    distance, _ = _residuals(design, values, found, relative_above)
    kept = np.sort(np.argpartition(distance, values.size - dropped)[: values.size - dropped])
    return _huber_fit(design[kept], values[kept], ridge, relative_above, found)


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
    """Absolute residuals, and the unit of each."""
    fitted = design @ found
    unit = 1.0 if relative_above is None else np.maximum(fitted, relative_above)
    return np.abs(values - fitted) / unit, unit


def _weighted_fit(design: Values, values: Values, weights: Values, ridge: Values) -> Values:
    weighted = design * weights[:, None]
    # A row counts less, and the penalty with it: the smoothness does not depend on how well a fit goes.
    return np.linalg.lstsq(design.T @ weighted + weights.sum() * ridge, weighted.T @ values)[0].astype(np.float64)


def _basis(normals: npt.ArrayLike) -> Values:
    return sh_basis(np.asarray(normals, np.float64), IRRADIANCE_SH_DEGREE).T.astype(np.float64)
