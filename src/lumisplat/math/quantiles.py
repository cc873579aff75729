"""Quantiles of values that count differently."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles


def weighted_quantile(values: Doubles, weights: Doubles, share: float) -> float:
    """The value below which a share of the weight is, between values by interpolation; of equal weights, NumPy's.

    Args:
        values: Shape (N,).
        weights: At least 0, one of them above it, shape (N,); values of weight 0 do not count.
        share: 0..1; 0 is the least value, 1 the largest.
    """
    kept = weights > 0.0
    order = np.argsort(values[kept], kind="stable")
    ordered, counted = values[kept][order], weights[kept][order]
    below: Doubles = np.cumsum(counted) - 0.5 * counted
    return float(np.interp(float(below[0] + share * (below[-1] - below[0])), below, ordered))
