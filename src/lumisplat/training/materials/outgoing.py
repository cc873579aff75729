"""What captured Gaussians show on average, linear: the light that a matte surface would send everywhere."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.materials import DARKEST, OUTGOING_COSINE, OUTGOING_DIRECTIONS
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import decode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.scene.gaussians import Gaussians

BLOCK = 4096
"""Gaussians whose colours are in memory at once."""


def mean_outgoing(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """The mean over views above each Gaussian, by their cosines, shape (N, 3)."""
    views = even_directions(OUTGOING_DIRECTIONS)
    basis = sh_basis(-views, gaussians.sh_degree)  # of where eyes look
    found = np.empty((gaussians.count, 3))
    for first in range(0, gaussians.count, BLOCK):
        rows = slice(first, first + BLOCK)
        cosines = normals[rows] @ views.T
        weights = np.where(cosines > OUTGOING_COSINE, cosines, 0.0)
        shown = np.clip(np.einsum("vk,nkc->nvc", basis, gaussians.sh[rows]) + 0.5, 0.0, 1.0)
        found[rows] = np.einsum("nv,nvc->nc", weights, decode_srgb(shown)) / weights.sum(axis=1, keepdims=True)
    return np.maximum(found, DARKEST)
