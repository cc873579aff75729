"""Lens distortion by radial and tangential polynomials (Brown 1971), with OpenCV's names and signs.

The equations are in docs/method/ray_tracing.md#distortion. Coordinates are those of the camera model before the focal
length is applied: tangents for a pinhole, radians for a fisheye.
"""

from __future__ import annotations

import numpy as np

from lumisplat.constants import DISTORTION_STEPS
from lumisplat.math.arrays import Doubles

DISTORTION_MIN = 1e-30
"""Magnitude below which a coefficient counts as 0: it moves no point, and its reciprocal overflows."""

DISTORTION_RESIDUAL = 1e-9
"""Largest error of the float64 inverse, in tangents or radians; pixels with a larger error stay empty."""

Coefficients = tuple[float, float, float, float, float, float]
"""Coefficients (k1, k2, k3, k4, p1, p2) of the lens distortion: radial k, tangential p."""


@np.errstate(over="ignore", invalid="ignore")
def distort(points: Doubles, coefficients: Coefficients) -> Doubles:
    """Applies the lens distortion to points, shape (..., 2); points too far out for float64 become infinite or NaN."""
    *_, p1, p2 = coefficients
    u, v, s, radial = _radial(points, coefficients)
    return np.stack(
        [
            u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u),
            v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v),
        ],
        axis=-1,
    )


def undistort(points: Doubles, coefficients: Coefficients) -> Doubles:
    """Inverts the lens distortion at points, shape (..., 2), by Newton's method; NaN for a point without a solution.

    If a point has several solutions, the one inside `distortion_reach` is returned: beyond it the polynomial folds
    back.
    """
    if not any(coefficients):
        return points
    reach = distortion_reach(coefficients)
    found = _within(points, reach)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for _ in range(DISTORTION_STEPS):
            error = distort(found, coefficients) - points
            is_found = np.abs(error).max(axis=-1, keepdims=True) <= 0.01 * DISTORTION_RESIDUAL
            if is_found.all():
                break
            better = _within(found - _solved(distortion_jacobian(found, coefficients), error), reach)
            found = np.where(is_found, found, better)  # so that the result at a point does not depend on other points
        error = np.abs(distort(found, coefficients) - points).max(axis=-1)
    found[~(error <= DISTORTION_RESIDUAL)] = np.nan
    return found


@np.errstate(all="ignore")
def distortion_reach(coefficients: Coefficients) -> float:
    """Returns the undistorted radius up to which the radial polynomial increases; inf if it always does."""
    k1, k2, k3, k4, _, _ = (k if abs(k) >= DISTORTION_MIN else 0.0 for k in coefficients)
    roots = np.roots([9.0 * k4, 7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])
    squares = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0.0)]
    return float(np.sqrt(squares.min())) if squares.size else np.inf


def distortion_jacobian(points: Doubles, coefficients: Coefficients) -> Doubles:
    """Returns the Jacobian of `distort` at points, shape (..., 2, 2)."""
    k1, k2, k3, k4, p1, p2 = coefficients
    u, v, s, radial = _radial(points, coefficients)
    slope = 2.0 * (k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * 4.0 * k4)))
    mixed = slope * u * v + 2.0 * (p1 * u + p2 * v)
    uu = radial + slope * u * u + 2.0 * p1 * v + 6.0 * p2 * u
    vv = radial + slope * v * v + 2.0 * p2 * u + 6.0 * p1 * v
    return np.stack([np.stack([uu, mixed], axis=-1), np.stack([mixed, vv], axis=-1)], axis=-2)


def _radial(points: Doubles, coefficients: Coefficients) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Returns u, v, u^2 + v^2 and the radial polynomial at points (u, v), four arrays of shape (...)."""
    k1, k2, k3, k4, _, _ = coefficients
    u, v = points[..., 0], points[..., 1]
    s = u * u + v * v
    return u, v, s, 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))


def _solved(matrices: Doubles, vectors: Doubles) -> Doubles:
    """Solves systems of two linear equations, ``matrices`` (..., 2, 2) and ``vectors`` (..., 2), by Cramer's rule."""
    a, b, c, d = matrices[..., 0, 0], matrices[..., 0, 1], matrices[..., 1, 0], matrices[..., 1, 1]
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([d * x - b * y, a * y - c * x], axis=-1) / (a * d - b * c)[..., None]


def _within(points: Doubles, reach: float) -> Doubles:
    """Moves points outside the circle of radius ``reach`` around the origin onto the circle."""
    if reach == np.inf:
        return np.array(points)
    radius = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * np.minimum(1.0, reach / np.maximum(radius, 1e-300))
