"""Pairs of Gaussians that are near each other."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.materials import NEIGHBOURS
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.editing.morton import morton_order
from lumisplat.training.materials.pairs import Pairs

WINDOW = 24
"""Places along a Morton curve, to both sides, among which neighbours are looked for."""
BLOCK = 16384
"""Gaussians whose neighbours are looked for at once."""


def near_pairs(means: FloatArray) -> Pairs:
    """Each Gaussian with the nearest of those that are near it along a Morton curve."""
    order = morton_order(means)
    points, count = means[order].astype(np.float64), len(means)
    reach, most = min(WINDOW, count - 1), min(NEIGHBOURS, count - 1)
    offsets = np.concatenate([np.arange(-reach, 0), np.arange(1, reach + 1)])
    near = np.empty((count, most), np.int64)
    for first in range(0, count, BLOCK):
        rows = np.arange(first, min(first + BLOCK, count))
        places = rows[:, None] + offsets
        inside = (places >= 0) & (places < count)
        places = np.clip(places, 0, count - 1)
        squares = np.where(inside, np.square(points[places] - points[rows, None]).sum(axis=2), np.inf)
        nearest = np.argsort(squares, axis=1, kind="stable")[:, :most]
        near[rows] = np.take_along_axis(places, nearest, axis=1)
    return Pairs(np.repeat(order, most), order[near.ravel()])
