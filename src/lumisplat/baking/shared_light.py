"""Less noise in light, direct or bounced: what rays find of it is shared among the Gaussians that they see.

The equations are in docs/method/relighting.md#baking.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.baking import SHARED_COLOR_MIN
from lumisplat.math.arrays import Doubles

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class SeenWeights:
    """With which weights P rays blend N Gaussians, in S sights."""

    ray: _Rows
    """Of each sight, shape (S,)."""
    gaussian: _Rows
    """Shape (S,)."""
    weight: Doubles
    """Shape (S,)."""
    rays: int
    gaussians: int

    def blended(self, values: Doubles) -> Doubles:
        """Sums over the Gaussians of each ray, (N, C) to (P, C)."""
        return self._summed(self.ray, self.weight[:, None] * values[self.gaussian], self.rays)

    def mean_of(self, values: Doubles) -> Doubles:
        """Means over the rays that see each Gaussian, (P, C) to (N, C); 0 where none does."""
        total = np.maximum(np.bincount(self.gaussian, self.weight, self.gaussians), 1e-12)
        return self._summed(self.gaussian, self.weight[:, None] * values[self.ray], self.gaussians) / total[:, None]

    @staticmethod
    def _summed(rows: _Rows, values: Doubles, count: int) -> Doubles:
        return np.stack([np.bincount(rows, column, count) for column in values.T], axis=1).astype(np.float64)


def shared_light(halves: Doubles, found: Doubles, colors: Doubles, seen: SeenWeights, slope: float) -> Doubles:
    """Light of what rays meet, drawn towards that of the same Gaussians on other rays, both halves of samples alike.

    Divided by the colours of what a ray meets, light changes little along a surface; so it is averaged over the rays
    that meet a Gaussian, and blended on each. Rays differ from that by their noise, which the difference of halves
    tells, and by edges of shadows and reflections, which stay. Where samples meet something or nothing by chance, light
    is that of those that do.

    Args:
        halves: Linear light by every other sample, and by the others, shape (2, P, 3).
        found: Share of these samples that met something, shape (2, P, 1).
        colors: Base colours of the Gaussians, linear, shape (N, 3).
        seen: Which Gaussians rays see.
        slope: How fast rays keep more of their own light the more they differ by more than their noise; by 1, as
            James and Stein (1961) have it.

    Returns:
        Of what is met alone, shape (2, P, 3): rays of which no sample has met anything show what others see there.
    """
    weight = np.maximum(seen.blended(np.ones((len(colors), 1))), 1e-12)
    base = np.maximum(seen.blended(colors) / weight, SHARED_COLOR_MIN)
    both = found.sum(axis=0)
    told = (found > 0.0).all(axis=0).astype(np.float64)  # by the difference of halves, where each has met something
    mean = halves.sum(axis=0) / np.maximum(both, 1e-12)
    halves = np.where(found > 0.0, halves / np.maximum(found, 1e-12), mean)
    received = seen.mean_of(np.concatenate([0.5 * both / weight * mean / base, 0.5 * both / weight], axis=1))
    shared = seen.blended(colors * received[:, :3] / np.maximum(received[:, 3:], 1e-12)) / weight
    halves = np.where(both > 0.0, halves, shared)
    mean, difference = halves.mean(axis=0) / base, 0.5 * (halves[0] - halves[1]) / base
    squares = told * np.stack([np.square(one).sum(axis=1) for one in (difference, mean - shared / base)], axis=1)
    noise, spread = seen.mean_of(squares).T
    kept = np.clip(slope * (1.0 - noise / np.maximum(spread, 1e-300)), 0.0, 1.0)[:, None]
    return shared + seen.blended(kept) / weight * (halves - shared)
