"""Irradiance and outgoing radiance of captured Gaussians, and the typical albedo that fixes their scale.

Only the product of light and albedo is visible, so the lightest albedos are taken to be typical.
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
"""Share of a ray that is met, below which its colour is not told."""

VIEW_DIRECTIONS = 16
"""Directions in which the colour of a Gaussian is looked at."""

VIEW_TILT = 0.5
"""By how much these are bent towards normals: at grazing angles, colours say little."""

ALBEDO_HIGH = 0.8
"""Albedo of the lightest surfaces in their lightest channel, that fixes the scale where light comes from the sky."""

UNIT_IRRADIANCE_MIN = 0.05
"""Light of the sky and lamps at a Gaussian, in medians, from which on it tells how bright these may be."""

UNSEEN_RADIANCE_MIN = 0.05
"""Radiance of the sky and lamps that the fit begins with, at least."""

LIGHTEST = 0.95
"""Share of Gaussians that are darker than those."""

SCALE_STEPS = 5
"""Steps by which the scale is found: what Gaussians show each other stays as it was captured."""

OUTGOING_DIRECTIONS = 64
"""Over the sphere, in which the captured colour of a Gaussian is looked at."""

OUTGOING_COSINE = 0.3
"""Of those with the normal, at least: flatter views are extrapolated."""

HalfArray = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance over pi of N Gaussians: what a white surface would show. Linear, in units of display white."""

    observed: Doubles
    """Of what the capture shows, without its lamps, shape (N, 3)."""
    environment: FloatArray
    """Of each of K cells of a sky of radiance 1, shape (N, K)."""
    emitters: FloatArray
    """Of each of L lamps of radiance 1, shape (N, L)."""
    directions: Doubles = field(default_factory=lambda: np.zeros((0, 3)))
    """Directions in which what the capture shows was kept apart, unit, shape (W, 3); none if it was not."""
    by_direction: HalfArray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float16))
    """The share of ``observed`` that comes from each, shape (W, N, 3)."""

    def total(self, environment: Doubles | FloatArray, emitters: Doubles) -> Doubles:
        """That of a sky and lamps, shape (N, 3).

        Args:
            environment: Radiances, shape (K, 3); float32 are multiplied as such, in half the memory.
            emitters: Likewise, shape (L, 3).
        """
        return self.observed + self.environment @ environment + self.emitters @ emitters


BLOCK = 4096
"""Gaussians whose colours from all sides are in memory at once."""


def median_outgoing(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """What Gaussians send to most directions before them, shape (N, 3): highlights, which few see, are not in it.

    Args:
        gaussians: A capture.
        normals: Unit, towards the side from which they are seen, shape (N, 3).
    """
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, gaussians.count))
        found[rows] = np.median(_outgoing_colors(gaussians.subset(rows), normals[rows]), axis=0)
    return found


def mean_outgoing(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """The mean over views above each Gaussian, by their cosines, shape (N, 3): photographs then tell highlights.

    Args:
        gaussians: A capture.
        normals: As of `median_outgoing`.
    """
    views = even_directions(OUTGOING_DIRECTIONS)
    basis = sh_basis(-views, gaussians.sh_degree)  # of where eyes look
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = slice(first, first + BLOCK)
        cosines = normals[rows] @ views.T
        weights = np.where(cosines > OUTGOING_COSINE, cosines, 0.0)
        colors = np.clip(np.einsum("vk,nkc->nvc", basis, gaussians.sh[rows]) + 0.5, 0.0, 1.0)
        found[rows] = np.einsum("nv,nvc->nc", weights, decode_srgb(colors)) / weights.sum(axis=1, keepdims=True)
    return np.maximum(found, RADIANCE_LEAST)


def hit_radiance(hits: RayHits, alpha: FloatArray | Doubles) -> FloatArray | Doubles:
    """Radiance of what rays meet, without their share that passes it, shape (N, 3); ``alpha`` is the rest."""
    return decode_srgb(np.clip(hits.radiance / np.maximum(alpha, ALPHA_LEAST)[:, None], 0.0, 1.0))


def _outgoing_colors(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Radiance into directions before Gaussians, which are bent towards their normals, shape (M, N, 3)."""
    radiances: list[FloatArray] = []
    for direction in even_directions(VIEW_DIRECTIONS):
        view = np.where(normals @ direction > 0.0, 1.0, -1.0)[:, None] * direction + VIEW_TILT * normals
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        radiances.append(decode_srgb(np.clip(colors_along(gaussians, -view), 0.0, 1.0)))
    return np.array(radiances, dtype=np.float64)


def unit_irradiance(incident: Irradiance) -> Doubles:
    """Irradiance over pi of the sky and lamps, each of radiance 1, shape (N,)."""
    return incident.environment.sum(axis=1, dtype=np.float64) + incident.emitters.sum(axis=1, dtype=np.float64)


def constant_radiance(outgoing: Doubles, incident: Irradiance, weights: Doubles) -> float:
    """Of a sky and lamps that are grey and the same everywhere; 1 if hardly any of their light arrives anywhere.

    Args:
        outgoing: Radiance of Gaussians, shape (N, 3).
        incident: What shines on them.
        weights: How much they count, at least 0, shape (N,).
    """
    added = unit_irradiance(incident)
    rows = (added > max(UNIT_IRRADIANCE_MIN * float(np.median(added)), 1e-9)) & (weights > 0.0)
    if not rows.any():
        return 1.0
    wanted = (outgoing[rows] / ALBEDO_HIGH - incident.observed[rows]).max(axis=1) / added[rows]
    return max(weighted_quantile(wanted, weights[rows], LIGHTEST), UNSEEN_RADIANCE_MIN)


def chroma_similarity(differences: Doubles, width: float) -> Doubles:
    """How likely pairs of surfaces have one albedo by their chromaticity, 0..1, shape (P, 1).

    Args:
        differences: Of the logarithms of their albedos, shape (P, 3).
        width: Standard deviation of the largest difference of chromaticity.
    """
    chroma = differences - differences.mean(axis=1, keepdims=True)
    return np.exp(-0.5 * np.square(np.abs(chroma).max(axis=1, keepdims=True) / width))


def typical_albedo_factor(outgoing: Doubles, observed: Doubles, added: Doubles, weights: Doubles) -> float:
    """By what a light is too dark; what Gaussians show each other stays as it was captured.

    In a few rounds, each of which comes nearer by the light's share: where Gaussians are lit mostly by each other, the
    lightest albedos stay between what they were and what is usual.

    Args:
        outgoing: Radiance of Gaussians, shape (N, 3).
        observed: Irradiance over pi of what the capture shows, shape (N, 3).
        added: Of the light, shape (N, 3).
        weights: How much Gaussians count, at least 0, shape (N,).
    """
    factor = 1.0
    for _ in range(SCALE_STEPS):
        irradiance = np.maximum(observed + factor * added, RADIANCE_LEAST)
        factor *= weighted_quantile((outgoing / irradiance).max(axis=1), weights, LIGHTEST) / ALBEDO_HIGH
    return factor
