"""Reduces the noise of baked light: rays share it among Gaussians, and directions share what is constant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, Flags

SHARED_COLOR_MIN = 0.02
"""Share of even light that rays show below which differences between rays count less: what they reflect is not noise of
light that others have, too."""

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RayWeights:
    """With which weights P rays blend N Gaussians, in S sights."""

    ray: _Rows
    """Ray of each sight, shape (S,)."""
    gaussian: _Rows
    """Gaussian of each sight, shape (S,)."""
    weight: Doubles
    """Shape (S,)."""
    rays: int
    gaussians: int

    def blended(self, values: Doubles) -> Doubles:
        """Sums over the Gaussians of each ray, (N, C) to (P, C)."""
        return _sums(self.ray, self.weight, self.gaussian, values, self.rays)

    def mean_of(self, values: Doubles) -> Doubles:
        """Means over the rays that see each Gaussian, (P, C) to (N, C); 0 where none does."""
        total = np.maximum(np.bincount(self.gaussian, self.weight, self.gaussians), 1e-12)
        return _sums(self.gaussian, self.weight, self.ray, values, self.gaussians) / total[:, None]


def _sums(to: _Rows, weight: Doubles, of: _Rows, values: Doubles, count: int) -> Doubles:
    """Weighted sums, column by column, which takes the least memory."""
    return np.stack([np.bincount(to, weight * column[of], count) for column in values.T], axis=1).astype(np.float64)


def denoised_by_rays(halves: Doubles, hit_share: Doubles, base: Doubles, weights: RayWeights, slope: float) -> Doubles:
    """Light of what rays meet, drawn towards that of the same Gaussians on other rays.

    Divided by what a ray would show of even light, light changes little along a surface; so it is averaged over the
    rays that see a Gaussian, and blended on each, as a ratio of sums: dark rays tell little of it. Rays differ from
    that by their noise, which the difference of halves tells, and by edges of shadows and reflections, which stay.
    Where samples meet something or nothing by chance, light is that of those that do.

    Args:
        halves: Linear light by every other sample, and by the others, shape (2, P, 3).
        hit_share: Share of these samples that met something, shape (2, P, 1).
        base: What rays that meet something show of even light of radiance 1, shape (P, 3).
        weights: Which Gaussians rays see.
        slope: How fast rays keep more of their own light the more they differ by more than their noise; by 1, as
            James and Stein (1961) have it.

    Returns:
        Of what is met alone, shape (2, P, 3), each half by itself: rays of which no sample has met anything show what
        others see there.
    """
    weight = np.maximum(weights.blended(np.ones((weights.gaussians, 1))), 1e-12)
    shared = np.stack([_averaged(*of_half, base, weights, weight) for of_half in zip(halves, hit_share, strict=True)])
    both = hit_share.sum(axis=0)
    measured = np.where(
        hit_share > 0.0, halves / np.maximum(hit_share, 1e-12), halves.sum(axis=0) / np.maximum(both, 1e-12)
    )
    measured = np.where(both > 0.0, measured, shared)
    both_hit = (
        (hit_share > 0.0).all(axis=0).astype(np.float64)
    )  # by the difference of halves, where each has met something
    least = np.maximum(base, SHARED_COLOR_MIN)
    deviation, difference = (measured - shared).mean(axis=0) / least, 0.5 * (measured[0] - measured[1]) / least
    squares = both_hit * np.stack([np.square(values).sum(axis=1) for values in (difference, deviation)], axis=1)
    noise, spread = weights.mean_of(squares).T
    shrinkage = np.clip(slope * (1.0 - noise / np.maximum(spread, 1e-300)), 0.0, 1.0)[:, None]
    return shared + weights.blended(shrinkage) / weight * (measured - shared)


def _averaged(light: Doubles, hit_share: Doubles, base: Doubles, weights: RayWeights, weight: Doubles) -> Doubles:
    """Returns what rays show of the mean light of their Gaussians, (P, 3); ``weight`` of all Gaussians, (P, 1)."""
    outgoing, received = (weights.blended(weights.mean_of(values / weight)) for values in (light, hit_share * base))
    return base * np.divide(outgoing, received, out=np.zeros_like(outgoing), where=received > 0.0)


def angularly_denoised(even: Doubles, odd: Doubles, weights: Doubles, front: Flags) -> tuple[Doubles, Doubles]:
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
    denoised_even, denoised_odd = even.copy(), odd.copy()
    for side in (front, ~front):
        shares = weights * side
        total = np.maximum(shares.sum(axis=1, keepdims=True), 1e-300)
        shares = (shares / total)[..., None]
        middle = (shares * mean).sum(axis=1, keepdims=True)
        spread = (shares * np.square(mean - middle)).sum(axis=(1, 2))
        noise = (shares * np.square(0.5 * (even - odd))).sum(axis=(1, 2))
        shrinkage = np.clip(1.0 - noise / np.maximum(spread, 1e-300), 0.0, 1.0)[:, None, None]
        for half, out in ((even, denoised_even), (odd, denoised_odd)):
            np.copyto(out, middle + shrinkage * (half - middle), where=side[..., None])
    return denoised_even, denoised_odd
