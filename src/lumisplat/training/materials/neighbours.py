"""The nearest neighbours of Gaussians."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from lumisplat.constants.materials import NEIGHBOURS
from lumisplat.math.arrays import FloatArray
from lumisplat.training.materials.alike_pairs import AlikePairs


def near_pairs(means: FloatArray) -> AlikePairs:
    """Returns pairs of each Gaussian with its `NEIGHBOURS` nearest others, fewer if there are not as many."""
    count = len(means)
    most = min(NEIGHBOURS, count - 1)
    if most < 1:
        return AlikePairs(np.empty(0, np.int64), np.empty(0, np.int64))
    _, near = cKDTree(means).query(means, k=most + 1, workers=-1)
    own = np.arange(count)[:, None]
    # Where means coincide, another may come before the Gaussian itself, and even push it off the list.
    is_own = near == own
    is_own[:, -1] |= ~is_own.any(axis=1)
    return AlikePairs(np.repeat(own, most), near[~is_own].astype(np.int64))
