"""Reflectance of smooth dielectrics and of sheen by quadrature on the host (docs/method/materials.md#sheen)."""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SHEEN_ROUGHNESS_MIN
from lumisplat.math.arrays import Doubles

_NODES = 64
"""Number of quadrature nodes; relative errors stay below 1e-9 for every index of refraction."""


def fresnel(cosine: npt.ArrayLike, ior: float) -> npt.NDArray[np.float64]:
    """Returns the Fresnel reflectance of a dielectric for unpolarised light from outside.

    Args:
        cosine: Cosine of the angle of incidence, positive, any shape.
        ior: Index of refraction behind the surface, divided by the index in front of the surface; at least 1.

    Returns:
        Reflectance 0..1, in the shape of ``cosine``.

    Source: docs/method/materials.md#smooth-surfaces.
    """
    facing = np.asarray(cosine, dtype=np.float64)
    beyond = np.sqrt((ior - 1.0) * (ior + 1.0) + facing**2)  # ior times the refracted ray's cosine
    across = (facing - beyond) / (facing + beyond)
    along = (ior * ior * facing - beyond) / (ior * ior * facing + beyond)
    return 0.5 * (across**2 + along**2)


@functools.lru_cache(maxsize=256)
def mean_fresnel(ior: float) -> float:
    """Returns the Fresnel reflectance under a constant environment: the cosine-weighted mean over the hemisphere.

    Args:
        ior: Relative index of refraction, at least 1.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    root = 0.5 * (nodes + 1.0)  # square root of the cosine, because reflectance rises steeply at grazing angles
    return float((2.0 * weights * root**3 * fresnel(root**2, ior)).sum())


_COSINES = np.concatenate([[0.01, 0.02, 0.035], np.linspace(0.05, 1.0, 20)])
_STEPS = 160
SHEEN_CURVES = 16
"""Number of intervals of roughness in the table of sheen albedos; the table has one entry more."""
_TABLE_STEPS = 64
_TABLE_MARGIN = 0.015
"""Offset added to the logarithms of sheen albedo in the table, because interpolation between entries underestimates."""
_SHAPE = np.array(
    [[21.5473, 25.3245], [3.82987, 3.32435], [0.19823, 0.16801], [-1.97760, -1.27393], [-4.32054, -4.85967]]
)
"""Parameters of the fit of sheen masking by Estevez and Kulla (2017): columns for roughness 1 and 0."""


def masking_curve(alpha: float) -> Doubles:
    """Returns the parameters a, b, c, d, e of the masking fit for sheen, equation (sheen-masking), shape (5,).

    ``alpha`` is the squared roughness. The equation is in docs/method/materials.md.
    """
    smooth = (1.0 - alpha) ** 2
    return _SHAPE @ np.array([1.0 - smooth, smooth])


def masking(cosine: Doubles, alpha: float) -> Doubles:
    """Returns Lambda, the masking function of sheen, for cosines to the normal; ``alpha`` is the squared roughness.

    It is equation (sheen-masking) in docs/method/materials.md.
    """
    a, b, c, d, e = masking_curve(alpha)

    def exponent(x: Doubles) -> Doubles:
        return a / (1.0 + b * x**c) + d * x + e

    below, above = exponent(cosine), 2.0 * exponent(np.asarray(0.5)) - exponent(1.0 - cosine)
    return np.exp(np.where(cosine < 0.5, below, above))


def sheen_albedo(cosine: float, alpha: float, steps: int = _STEPS) -> float:
    """Returns the directional albedo of white sheen, by the midpoint rule; it exceeds 1 at grazing angles.

    Args:
        cosine: Cosine of the angle between view direction and normal.
        alpha: Squared roughness.
        steps: Quadrature steps along each of two axes.
    """
    z, azimuth = np.meshgrid(*2 * [(np.arange(steps) + 0.5) / steps], indexing="ij")
    sine, view = np.sqrt(1.0 - z**2), np.sqrt(1.0 - cosine**2)
    half = np.stack([sine * np.cos(np.pi * azimuth) + view, sine * np.sin(np.pi * azimuth), z + cosine])
    across2 = 1.0 - half[2] ** 2 / (half**2).sum(axis=0)
    facets = (2.0 + 1.0 / alpha) * np.maximum(across2, 0.0) ** (0.5 / alpha) / (2.0 * np.pi)
    masked = 1.0 + masking(np.asarray(cosine), alpha) + masking(z, alpha)
    return float((facets / (4.0 * cosine * masked)).mean() * 2.0 * np.pi)


@functools.lru_cache(maxsize=256)
def albedo_curve(roughness: float, steps: int = _STEPS) -> tuple[float, float, float, float]:
    """Fits a cubic polynomial of the cosine to the logarithm of the sheen albedo.

    Where the albedo is above 0.1, the fit is never too small.

    Args:
        roughness: Roughness of the sheen, 0..1.
        steps: Quadrature steps along each of two axes.
    """
    alpha = max(roughness, SHEEN_ROUGHNESS_MIN) ** 2
    truth = np.array([sheen_albedo(cosine, alpha, steps) for cosine in _COSINES])
    powers = _COSINES[:, None] ** np.arange(4)
    weights = np.maximum(truth, 1e-3)
    fit = np.zeros(4)
    for _ in range(20):
        scaled = weights[:, None]
        fit = np.linalg.lstsq(powers * scaled, np.log(np.maximum(truth, 1e-7)) * weights, rcond=None)[0]
        error = np.abs(np.exp(powers @ fit) - truth)
        weights = np.maximum(truth, 1e-3) * (1.0 + 20.0 * error / max(truth.max(), 1.0))
    fitted = truth > 0.1
    fit[0] += max(float(np.log(truth[fitted] / np.exp(powers[fitted] @ fit)).max()), 0.0)
    return float(fit[0]), float(fit[1]), float(fit[2]), float(fit[3])


@functools.cache
def albedo_curves() -> Doubles:
    """Returns `albedo_curve` for a table of roughnesses, shape (SHEEN_CURVES + 1, 4); kernels interpolate it linearly.

    Entry k has roughness ``r + (1 - r) (k / SHEEN_CURVES)^2``, where r is the smallest roughness.
    """
    spaced = np.linspace(0.0, 1.0, SHEEN_CURVES + 1) ** 2
    roughness = SHEEN_ROUGHNESS_MIN + (1.0 - SHEEN_ROUGHNESS_MIN) * spaced
    curves = np.array([albedo_curve(float(one), _TABLE_STEPS) for one in roughness])
    curves[:, 0] += _TABLE_MARGIN
    return curves
