"""Less noise in what Gaussians show: what does not depend on the direction is known from all of them."""

from __future__ import annotations

import numpy as np

from lumisplat.math.arrays import Doubles, Flags


def steadied(even: Doubles, odd: Doubles, weights: Doubles, front: Flags) -> tuple[Doubles, Doubles]:
    """Both halves of the samples, drawn towards the mean of their side as much as noise spreads them.

    The spread of directions around their mean is that of what they show and of noise, which the difference of halves
    tells: the factor 1 - noise / spread leaves what they show (James and Stein 1961). Matte sides become even, those
    that reflect highlights stay. Shown light is linear here, so that means are unbiased.

    Args:
        even: Linear light by every other sample, shape (N, D, 3).
        odd: By the others.
        weights: Of the directions, shape (N, D).
        front: Which show the front, shape (N, D).
    """
    mean = 0.5 * (even + odd)
    steady_even, steady_odd = even.copy(), odd.copy()
    for side in (front, ~front):
        shares = weights * side
        total = np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
        shares = (shares / total)[..., None]
        middle = (shares * mean).sum(axis=1, keepdims=True)
        spread = (shares * np.square(mean - middle)).sum(axis=(1, 2))
        noise = (shares * np.square(0.5 * (even - odd))).sum(axis=(1, 2))
        kept = np.clip(1.0 - noise / np.maximum(spread, 1e-300), 0.0, 1.0)[:, None, None]
        for half, out in ((even, steady_even), (odd, steady_odd)):
            np.copyto(out, middle + kept * (half - middle), where=side[..., None])
    return steady_even, steady_odd
