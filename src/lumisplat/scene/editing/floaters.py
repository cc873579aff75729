"""Gaussians that float alone: strays of training, with few others around them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from lumisplat.constants import FLOATER_NEIGHBOURS, FLOATER_REACH
from lumisplat.scene.checks import check_argument, check_positive, check_whole
from lumisplat.scene.editing.remaining import remaining
from lumisplat.scene.gaussians import Gaussians

_BLOCK = 2**16
"""Gaussians that are searched for at a time, between two reports of progress."""


def remove_floaters(
    gaussians: Gaussians,
    neighbours: int = FLOATER_NEIGHBOURS,
    reach: float = FLOATER_REACH,
    *,
    progress: Callable[[float], None] | None = None,
) -> Gaussians:
    """Removes Gaussians that have fewer than so many others around them.

    Others count if their means are within ``reach`` times the Gaussian's largest scale, or times the capture's median
    largest scale if that is more. So wide Gaussians of a far background, which lie far apart, stay. A clump of floaters
    of more than ``neighbours`` stays, too: `crop` and `select` remove it.

    Args:
        gaussians: The capture.
        neighbours: Least number of others, 1 or more.
        reach: Distance in scales, above 0.
        progress: Called with the fraction done, 0..1.

    Returns:
        The others, in their order, unchanged.

    Raises:
        SceneError: An argument is out of range, or no Gaussian is left.
    """
    check_argument("remove_floaters", gaussians, Gaussians, "Gaussians")
    check_whole("neighbours", neighbours, 1, 1_000_000)
    check_positive("reach", reach)
    largest = gaussians.scales.max(axis=1)
    typical = np.float32(np.median(largest))
    radii = np.float32(reach) * np.maximum(largest, typical)
    tree, floating = cKDTree(gaussians.means), np.empty(gaussians.count, np.bool_)
    for start in range(0, gaussians.count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        # A Gaussian is the first of its own neighbours; those that do not exist are infinitely far.
        distance, _ = tree.query(gaussians.means[rows], k=[neighbours + 1])
        floating[rows] = distance[:, 0] > radii[rows]
        if progress:
            progress(min(start + _BLOCK, gaussians.count) / gaussians.count)
    return remaining(gaussians, ~floating)
