"""Irradiance and outgoing radiance of captured Gaussians, and the scale of light that makes albedos typical.

Only the product of light and albedo is visible, so the lightest surfaces are assumed to have a typical albedo.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lumisplat.constants import RADIANCE_LEAST
from lumisplat.math.arrays import Doubles, FloatArray, weighted_quantile
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.renderer.rays import RayHits
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along

ALPHA_LEAST = 1e-6
"""Lower bound of a ray's alpha when the ray's colour is divided by it."""

VIEW_DIRECTIONS = 16
"""Number of directions from which a Gaussian's colour is evaluated for the median."""

VIEW_TILT = 0.5
"""Weight of the normal that is added to view directions, because colours at grazing angles are unreliable."""

ALBEDO_HIGH = 0.8
"""Assumed albedo of the lightest surfaces in their largest channel, which fixes the scale of estimated light."""

UNIT_IRRADIANCE_MIN = 0.05
"""Irradiance of a Gaussian from environment and emitters, relative to the median, from which the Gaussian helps to
determine their radiance."""

UNSEEN_RADIANCE_MIN = 0.05
"""Smallest initial radiance of environment and emitters in the light fit."""

LIGHTEST = 0.95
"""Quantile of the Gaussians' albedos that is scaled to `ALBEDO_HIGH`."""

SCALE_STEPS = 5
"""Number of fixed-point steps for the scale of the light; several are needed because the scale does not apply to
irradiance from the capture itself."""

OUTGOING_DIRECTIONS = 64
"""Number of directions over the sphere from which a Gaussian's colour is evaluated for the mean."""

OUTGOING_COSINE = 0.3
"""Smallest cosine between normal and view direction of the mean's views; SH extrapolate at more grazing views."""

HalfArray = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance over pi of N Gaussians by source of light; a white diffuse surface would have this radiance.

    Values are linear, in units of display white.
    """

    observed: Doubles
    """Irradiance from the capture itself, without its emitters, shape (N, 3)."""
    environment: FloatArray
    """Irradiance from each of K environment cells with radiance 1, shape (N, K)."""
    emitters: FloatArray
    """Irradiance from each of L emitters with radiance 1, shape (N, L)."""
    directions: Doubles = field(default_factory=lambda: np.zeros((0, 3)))
    """The W unit directions for which the observed irradiance is also stored separately, shape (W, 3); may be empty."""
    by_direction: HalfArray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float16))
    """Part of ``observed`` that comes from each of ``directions``, shape (W, N, 3)."""

    def total(self, environment: Doubles | FloatArray, emitters: Doubles) -> Doubles:
        """Returns the total irradiance over pi of N Gaussians for given radiances, shape (N, 3).

        Args:
            environment: Radiances of the K environment cells, shape (K, 3); float32 needs half the memory.
            emitters: Radiances of the L emitters, shape (L, 3).
        """
        return self.observed + self.environment @ environment + self.emitters @ emitters


BLOCK = 4096
"""Number of Gaussians whose colours from all directions are in memory at once."""


def median_outgoing(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns the median radiance of N Gaussians over views of their visible side, without highlights, shape (N, 3).

    Args:
        gaussians: A capture.
        normals: Unit normals towards the visible side, shape (N, 3).
    """
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, gaussians.count))
        found[rows] = np.median(_outgoing_colors(gaussians.subset(rows), normals[rows]), axis=0)
    return found


def mean_outgoing(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns the cosine-weighted mean radiance of N Gaussians over views of their visible side, shape (N, 3).

    The mean includes highlights, for fits in which images determine the highlights.

    Args:
        gaussians: A capture.
        normals: As for `median_outgoing`.
    """
    views = even_directions(OUTGOING_DIRECTIONS)
    basis = sh_basis(-views, gaussians.sh_degree)  # SH take the direction from the camera
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = slice(first, first + BLOCK)
        cosines = normals[rows] @ views.T
        weights = np.where(cosines > OUTGOING_COSINE, cosines, 0.0)
        colors = np.clip(np.einsum("vk,nkc->nvc", basis, gaussians.sh[rows]) + 0.5, 0.0, 1.0)
        found[rows] = np.einsum("nv,nvc->nc", weights, decode_srgb(colors)) / weights.sum(axis=1, keepdims=True)
    return np.maximum(found, RADIANCE_LEAST)


def hit_radiance(hits: RayHits, alpha: FloatArray | Doubles) -> FloatArray | Doubles:
    """Returns the linear radiance of the surfaces that N rays hit, without the rays' transparency, shape (N, 3).

    Args:
        hits: Hits with display-referred colours weighted by alpha.
        alpha: Alpha of each ray, by which its colour is divided, shape (N,).
    """
    return decode_srgb(np.clip(hits.radiance / np.maximum(alpha, ALPHA_LEAST)[:, None], 0.0, 1.0))


def _outgoing_colors(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns the radiance of N Gaussians towards M view directions, bent towards their normals, shape (M, N, 3)."""
    radiances: list[FloatArray] = []
    for direction in even_directions(VIEW_DIRECTIONS):
        view = np.where(normals @ direction > 0.0, 1.0, -1.0)[:, None] * direction + VIEW_TILT * normals
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        radiances.append(decode_srgb(np.clip(colors_along(gaussians, -view), 0.0, 1.0)))
    return np.array(radiances, dtype=np.float64)


def unit_irradiance(incident: Irradiance) -> Doubles:
    """Returns the irradiance over pi of N Gaussians if environment and emitters had radiance 1, shape (N,)."""
    return incident.environment.sum(axis=1, dtype=np.float64) + incident.emitters.sum(axis=1, dtype=np.float64)


def constant_radiance(outgoing: Doubles, incident: Irradiance, weights: Doubles) -> float:
    """Estimates one grey radiance for environment and emitters; 1 if hardly any of their light reaches a Gaussian.

    Args:
        outgoing: Outgoing radiance of N Gaussians, shape (N, 3).
        incident: Irradiance of the Gaussians.
        weights: Weights of the Gaussians, at least 0, shape (N,).
    """
    added = unit_irradiance(incident)
    rows = (added > max(UNIT_IRRADIANCE_MIN * float(np.median(added)), 1e-9)) & (weights > 0.0)
    if not rows.any():
        return 1.0
    wanted = (outgoing[rows] / ALBEDO_HIGH - incident.observed[rows]).max(axis=1) / added[rows]
    return max(weighted_quantile(wanted, weights[rows], LIGHTEST), UNSEEN_RADIANCE_MIN)


def chroma_similarity(differences: Doubles, width: float) -> Doubles:
    """Returns the likelihood, by chromaticity, that the two surfaces of P pairs have one albedo, 0..1, shape (P, 1).

    Args:
        differences: Differences of the logarithms of the pairs' albedos, shape (P, 3).
        width: Standard deviation of the largest difference of chromaticity.
    """
    chroma = differences - differences.mean(axis=1, keepdims=True)
    return np.exp(-0.5 * np.square(np.abs(chroma).max(axis=1, keepdims=True) / width))


def typical_albedo_factor(outgoing: Doubles, observed: Doubles, added: Doubles, weights: Doubles) -> float:
    """Returns the factor by which the light must be scaled for the lightest albedos to be typical.

    Irradiance from the capture itself is not scaled, so the factor is found in fixed-point steps. Each step closes the
    gap by the light's fraction of the irradiance. Where Gaussians are mainly lit by each other, the lightest albedos
    end up between their first and the typical value.

    Args:
        outgoing: Outgoing radiance of N Gaussians, shape (N, 3).
        observed: Irradiance over pi from the capture itself, shape (N, 3).
        added: Irradiance over pi from the light, shape (N, 3).
        weights: Weights of the Gaussians, at least 0, shape (N,).
    """
    factor = 1.0
    for _ in range(SCALE_STEPS):
        irradiance = np.maximum(observed + factor * added, RADIANCE_LEAST)
        factor *= weighted_quantile((outgoing / irradiance).max(axis=1), weights, LIGHTEST) / ALBEDO_HIGH
    return factor
