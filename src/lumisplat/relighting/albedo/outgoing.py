"""Radiance that captured Gaussians send out, linear, in units of display white: by harmonics, and as rays meet it."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.delight import ALPHA_LEAST, RADIANCE_LEAST, VIEW_DIRECTIONS, VIEW_TILT
from lumisplat.constants.materials import OUTGOING_COSINE, OUTGOING_DIRECTIONS
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.renderer.ray_queries import RayHits
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along

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
        found[rows] = np.median(_before(gaussians.subset(rows), normals[rows]), axis=0)
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
        shown = np.clip(np.einsum("vk,nkc->nvc", basis, gaussians.sh[rows]) + 0.5, 0.0, 1.0)
        found[rows] = np.einsum("nv,nvc->nc", weights, decode_srgb(shown)) / weights.sum(axis=1, keepdims=True)
    return np.maximum(found, RADIANCE_LEAST)


def radiance_met(hits: RayHits, alpha: FloatArray | Doubles) -> FloatArray | Doubles:
    """Radiance of what rays meet, without their share that passes it, shape (N, 3); ``alpha`` is the rest."""
    return decode_srgb(np.clip(hits.radiance / np.maximum(alpha, ALPHA_LEAST)[:, None], 0.0, 1.0))


def _before(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Radiance into directions before Gaussians, which are bent towards their normals, shape (M, N, 3)."""
    seen: list[FloatArray] = []
    for direction in even_directions(VIEW_DIRECTIONS):
        way = np.where(normals @ direction > 0.0, 1.0, -1.0)[:, None] * direction + VIEW_TILT * normals
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        seen.append(decode_srgb(np.clip(colors_along(gaussians, -way), 0.0, 1.0)))
    return np.array(seen, dtype=np.float64)
