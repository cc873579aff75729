"""Pairs of neighbours on surfaces, about so many of each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from lumisplat.scene.sampling.blue_noise import Pairs

_ROUNDS = 4
"""Radii that are tried after the first one."""


def pairs_of_about(
    count: int, points: npt.NDArray[np.floating], pairs_within: Callable[[float], Pairs]
) -> tuple[Pairs, float]:
    """Pairs of points within a radius, chosen so that the median point has about ``count`` others, and the radius.

    On a surface the number grows with the square of the radius: it is guessed, and then corrected by what is found.

    Args:
        count: Of a point's pairs.
        points: Shape (N, 3).
        pairs_within: Pairs closer than a radius, each in both orders.
    """
    low, high = np.quantile(points, [0.25, 0.75], axis=0)
    radius = max(float(np.linalg.norm(high - low)) * np.sqrt(count / len(points)), 1e-9)
    pairs = pairs_within(radius)
    for _ in range(_ROUNDS):
        typical = max(float(np.median(np.bincount(pairs.first, minlength=len(points)))), 1.0)
        if 0.7 < typical / count < 1.6:
            break
        radius *= float(np.clip(np.sqrt(count / typical), 0.25, 3.0))
        pairs = pairs_within(radius)
    return pairs, radius
