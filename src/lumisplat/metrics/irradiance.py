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
    IRRADIANCE_SH_DEGREE,
    IRRADIANCE_SMOOTHNESS,
    MAD_PER_DEVIATION,
    TRIMMED_SHARE,
)
from lumisplat.errors import SceneError
from lumisplat.scene.harmonics import sh_basis

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

    The fit is Huber's, without the 5 % of the points that fit worst; where no normals look, irradiance stays smooth.

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
    mean = float(values.mean())
    if not mean > 0.0:
        raise SceneError(f"all {values.size:,} {name} are black: they tell nothing of the light")
    basis = _basis(normals)
    penalty = IRRADIANCE_SMOOTHNESS * values.size * (_BANDS * (_BANDS + 1.0))
    fitted = robust_fit(basis, values / mean, penalty)
    total = float(np.abs(fitted).sum())
    coefficients = fitted / total
    irradiance = basis @ coefficients
    scales = np.divide(values, irradiance, out=np.zeros_like(values), where=irradiance > 0.0)
    return Irradiance(coefficients, np.maximum(scales, 0.0))


def robust_fit(design: Values, values: Values, penalty: Values | None = None) -> Values:
    """Coefficients x for which ``design @ x`` is near ``values``: Huber's loss over all but the worst 5 % of the rows.

    Iteratively reweighted least squares from the plain fit. Huber's width follows the median absolute residual, so that
    the fit of values c times as large is c times as large.

    Args:
        design: Shape (N, K).
        values: Shape (N,).
        penalty: Weight of each squared coefficient, shape (K,); None: none has one.

    Returns:
        Shape (K,); of several as good the smallest.
    """
    dropped = int(TRIMMED_SHARE * values.size)
    smallest = FIT_TOLERANCE * max(float(np.abs(values).max()), np.finfo(np.float64).tiny)
    ridge = np.diag(np.zeros(design.shape[1]) if penalty is None else penalty)
    found = _weighted_fit(design, values, np.ones_like(values), ridge)
    for _ in range(FIT_STEPS_MAX):
        distance = np.abs(values - design @ found)
        weights = np.ones_like(values)
        if dropped:
            weights[np.argpartition(distance, values.size - dropped)[values.size - dropped :]] = 0.0
        deviation = float(np.median(distance[weights > 0.0])) / MAD_PER_DEVIATION
        width = max(HUBER_WIDTH * deviation, smallest)
        weights *= np.minimum(1.0, width / np.maximum(distance, smallest))
        before, found = found, _weighted_fit(design, values, weights, ridge)
        if np.abs(found - before).max() <= FIT_TOLERANCE * np.abs(found).max():
            break
    return found


def _weighted_fit(design: Values, values: Values, weights: Values, ridge: Values) -> Values:
    weighted = design * weights[:, None]
    return np.linalg.lstsq(design.T @ weighted + ridge, weighted.T @ values)[0]


def _basis(normals: npt.ArrayLike) -> Values:
    return sh_basis(np.asarray(normals, np.float64), IRRADIANCE_SH_DEGREE).T
