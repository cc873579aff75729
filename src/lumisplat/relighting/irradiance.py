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
"""Lower bound of a ray's alpha when the alpha-weighted colour of the ray is divided by the alpha."""

VIEW_DIRECTIONS = 16
"""Number of view directions over which the median of a Gaussian's colour is taken."""

VIEW_TILT = 0.5
"""Multiple of the unit normal that is added to each unit view direction: SH colours at grazing angles are unreliable.
"""

ALBEDO_HIGH = 0.8
"""Assumed albedo of the lightest surfaces in their largest channel. This assumption fixes the scale of estimated
light."""

UNIT_IRRADIANCE_MIN = 0.05
"""A Gaussian is used to estimate the radiance of environment and emitters only if the irradiance that these two would
give it with radiance 1, relative to the median Gaussian's, is above this."""

UNSEEN_RADIANCE_MIN = 0.05
"""Lower bound of the initial radiance of environment and emitters, in units of display white."""

LIGHTEST = 0.95
"""Quantile of the Gaussians' albedos that is scaled to `ALBEDO_HIGH`."""

SCALE_STEPS = 5
"""Number of fixed-point iterations for the scale of the light. One is not enough, because irradiance from the capture
itself does not grow with this scale."""

OUTGOING_DIRECTIONS = 64
"""Number of view directions, evenly over the sphere, over which the mean of a Gaussian's colour is taken."""

OUTGOING_COSINE = 0.3
"""Smallest cosine between a Gaussian's normal and a view direction at which the view enters the mean colour: SH
extrapolate at grazing views.
"""

HalfArray = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance over pi at N Gaussians, split by source: capture, environment cells and emitters.

    Irradiance over pi is the radiance of a white diffuse surface: linear, in units of display white.
    """

    observed: Doubles
    """Irradiance over pi from the Gaussians of the capture, without its emitters, linear, shape (N, 3)."""
    environment: FloatArray
    """Irradiance over pi that each of K environment cells would give with radiance 1, shape (N, K)."""
    emitters: FloatArray
    """Irradiance over pi that each of L emitters would give with radiance 1, shape (N, L)."""
    directions: Doubles = field(default_factory=lambda: np.zeros((0, 3)))
    """The W unit directions of ``by_direction``, world space, shape (W, 3); W is 0 if ``by_direction`` is not stored.
    """
    by_direction: HalfArray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float16))
    """Parts of ``observed`` by direction of arrival: row w is the part from the direction ``directions[w]``, shape (W,
    N, 3)."""

    def total(self, environment: Doubles | FloatArray, emitters: Doubles) -> Doubles:
        """Returns the total irradiance over pi of N Gaussians for given radiances, shape (N, 3).

        Args:
            environment: Radiances of the K environment cells, shape (K, 3); float32 needs half the memory.
            emitters: Radiances of the L emitters, shape (L, 3).
        """
        return self.observed + self.environment @ environment + self.emitters @ emitters


BLOCK = 4096
"""Number of Gaussians whose colours in all view directions are evaluated at once, to limit memory."""


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
    """Returns the linear radiance of the surfaces that N rays hit, as if each surface were opaque, shape (N, 3).

    Args:
        hits: Hits with display-referred colours weighted by alpha.
        alpha: Alpha of each ray, by which the ray's colour is divided, shape (N,).
    """
    return decode_srgb(np.clip(hits.radiance / np.maximum(alpha, ALPHA_LEAST)[:, None], 0.0, 1.0))


def _outgoing_colors(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns N Gaussians' linear radiance towards M views on the side of the normal, (M, N, 3).

    The views are tilted towards the normal.
    """
    radiances: list[FloatArray] = []
    for direction in even_directions(VIEW_DIRECTIONS):
        view = np.where(normals @ direction > 0.0, 1.0, -1.0)[:, None] * direction + VIEW_TILT * normals
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        radiances.append(decode_srgb(np.clip(colors_along(gaussians, -view), 0.0, 1.0)))
    return np.array(radiances, dtype=np.float64)


def unit_irradiance(incident: Irradiance) -> Doubles:
    """Returns the irradiance / pi that environment and emitters would give at N Gaussians with radiance 1, (N,)."""
    return incident.environment.sum(axis=1, dtype=np.float64) + incident.emitters.sum(axis=1, dtype=np.float64)


def constant_radiance(outgoing: Doubles, incident: Irradiance, weights: Doubles) -> float:
    """Estimates one radiance for environment and emitters that gives the lightest surfaces an albedo of 0.8.

    The radiance is 1 if hardly any light of environment and emitters reaches a Gaussian.

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


def chroma_similarity(differences: Doubles, width: float | Doubles) -> Doubles:
    """Returns for P pairs the likelihood, 0..1, that both surfaces have one albedo, by chromaticity, shape (P, 1).

    Args:
        differences: Differences of the logarithms of the pairs' albedos, shape (P, 3).
        width: Standard deviation, natural logarithm, of the largest deviation of a channel from the channels' mean: one
            number, or shape (P, 1).
    """
    chroma = differences - differences.mean(axis=1, keepdims=True)
    return np.exp(-0.5 * np.square(np.abs(chroma).max(axis=1, keepdims=True) / width))


def typical_albedo_factor(outgoing: Doubles, observed: Doubles, added: Doubles, weights: Doubles) -> float:
    """Returns the factor on the light of environment and emitters that brings the lightest albedos to 0.8.

    Irradiance from the capture itself is not scaled, so the factor is found in fixed-point steps. Each step closes only
    the fraction of the gap that the scaled light has in the irradiance. If Gaussians are mainly lit by each other, the
    lightest albedos therefore end up between their initial value and 0.8.

    Args:
        outgoing: Outgoing radiance of N Gaussians, shape (N, 3).
        observed: Irradiance over pi from the capture itself, shape (N, 3).
        added: Irradiance over pi from environment and emitters, which the factor scales, shape (N, 3).
        weights: Weights of the Gaussians, at least 0, shape (N,).
    """
    factor = 1.0
    for _ in range(SCALE_STEPS):
        irradiance = np.maximum(observed + factor * added, RADIANCE_LEAST)
        factor *= weighted_quantile((outgoing / irradiance).max(axis=1), weights, LIGHTEST) / ALBEDO_HIGH
    return factor
