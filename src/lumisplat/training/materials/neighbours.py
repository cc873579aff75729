"""Pairs of Gaussians that are near each other."""

from __future__ import annotations

import numpy as np

from lumisplat.constants.materials import NEIGHBOURS
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.editing.morton import morton_order
from lumisplat.training.materials.pairs import Pairs

WINDOW = 24
"""Places along a Morton curve, to both sides, among which neighbours are looked for."""


def near_pairs(means: FloatArray) -> Pairs:
    """Each Gaussian with the nearest of those that are near it along a Morton curve."""
    order = morton_order(means)
    points, count = means[order].astype(np.float64), len(means)
    reach = min(WINDOW, count - 1)
    offsets = np.concatenate([np.arange(-reach, 0), np.arange(1, reach + 1)])
    places = np.arange(count)[:, None] + offsets
    inside = (places >= 0) & (places < count)
    places = np.clip(places, 0, count - 1)
    squares = np.where(inside, np.square(points[places] - points[:, None]).sum(axis=2), np.inf)
    nearest = np.argsort(squares, axis=1, kind="stable")[:, : min(NEIGHBOURS, count - 1)]
    rows = np.repeat(np.arange(count), nearest.shape[1])
    return Pairs(order[rows], order[np.take_along_axis(places, nearest, axis=1).ravel()])
