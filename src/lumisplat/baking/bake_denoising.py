"""Denoises baked light: over rays that view the same Gaussians, and over directions (James-Stein shrinkage)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, Flags

SHARED_COLOR_MIN = 0.02
"""Lower bound of the divisor of a ray's deviation from the shared radiance.

The divisor is the colour of the ray's hits in a constant environment of radiance 1. Deviations of darker rays thus
count less, because they are due to reflections rather than to noise of the light."""

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RayWeights:
    """Blend weights of N Gaussians on P rays, a sparse matrix with S entries that are not zero."""

    ray: _Rows
    """Index of the ray of each of S blend weights, shape (S,)."""
    gaussian: _Rows
    """Index of the Gaussian of each of S blend weights, shape (S,)."""
    weight: Doubles
    """Blend weights of Gaussians on rays, S in number, shape (S,)."""
    rays: int
    gaussians: int

    def blended(self, values: Doubles) -> Doubles:
        """Blends C values of N Gaussians along each of P rays, by blend weight: shape (N, C) to (P, C)."""
        return _sums(self.ray, self.weight, self.gaussian, values, self.rays)

    def mean_of(self, values: Doubles) -> Doubles:
        """Averages C values of P rays over each of N Gaussians, by blend weight: (P, C) to (N, C); 0 without rays."""
        total = np.maximum(np.bincount(self.gaussian, self.weight, self.gaussians), 1e-12)
        return _sums(self.gaussian, self.weight, self.ray, values, self.gaussians) / total[:, None]


def _sums(to: _Rows, weight: Doubles, of: _Rows, values: Doubles, count: int) -> Doubles:
    """Multiplies a sparse matrix by ``values``, one column at a time to save memory.

    The matrix has ``count`` rows and the entries ``weight`` in rows ``to`` and columns ``of``.
    """
    return np.stack([np.bincount(to, weight * column[of], count) for column in values.T], axis=1).astype(np.float64)


def denoised_by_rays(halves: Doubles, hit_share: Doubles, base: Doubles, weights: RayWeights, slope: float) -> Doubles:
    """Shrinks the radiance of P rays towards the mean radiance of the same Gaussians on other rays.

    Radiance divided by the ray's colour in a constant environment varies little along a surface. This ratio is averaged
    over the rays that view a Gaussian, then blended on each ray. Both steps are ratios of sums, so that dark rays count
    little. A ray's deviation from its blended mean is noise plus signal. The difference between the two halves of the
    samples estimates the noise. The shrinkage keeps the signal, such as shadow edges and reflections. With stochastic
    coverage, radiance is that of the samples that hit something.

    Args:
        halves: Linear radiance of the even and of the odd samples, shape (2, P, 3).
        hit_share: Fraction of the even and of the odd samples that hit something, shape (2, P, 1).
        base: Colour of each ray's hits in a constant environment of radiance 1, shape (P, 3).
        weights: Blend weights of Gaussians on the rays.
        slope: Slope of the shrinkage: how quickly a ray keeps its own radiance as its deviation exceeds the noise. With
            1, the estimator is that of James and Stein (1961).

    Returns:
        Radiance of the hits, without the samples that hit nothing, for each half of the samples, shape (2, P, 3). Rays
        without any hit get the mean of other rays.
    """
    weight = np.maximum(weights.blended(np.ones((weights.gaussians, 1))), 1e-12)
    shared = np.stack([_averaged(*of_half, base, weights, weight) for of_half in zip(halves, hit_share, strict=True)])
    both = hit_share.sum(axis=0)
    measured = np.where(
        hit_share > 0.0, halves / np.maximum(hit_share, 1e-12), halves.sum(axis=0) / np.maximum(both, 1e-12)
    )
    measured = np.where(both > 0.0, measured, shared)
    # The difference of the halves estimates the noise only where both halves have hits.
    both_hit = (hit_share > 0.0).all(axis=0).astype(np.float64)
    least = np.maximum(base, SHARED_COLOR_MIN)
    deviation, difference = (measured - shared).mean(axis=0) / least, 0.5 * (measured[0] - measured[1]) / least
    squares = both_hit * np.stack([np.square(values).sum(axis=1) for values in (difference, deviation)], axis=1)
    noise, spread = weights.mean_of(squares).T
    shrinkage = np.clip(slope * (1.0 - noise / np.maximum(spread, 1e-300)), 0.0, 1.0)[:, None]
    return shared + weights.blended(shrinkage) / weight * (measured - shared)


def _averaged(light: Doubles, hit_share: Doubles, base: Doubles, weights: RayWeights, weight: Doubles) -> Doubles:
    """Returns the radiance of P rays if every Gaussian had its mean radiance over all rays, shape (P, 3).

    ``weight`` is the sum of the blend weights of each ray, shape (P, 1).
    """
    outgoing, received = (weights.blended(weights.mean_of(values / weight)) for values in (light, hit_share * base))
    return base * np.divide(outgoing, received, out=np.zeros_like(outgoing), where=received > 0.0)


def angularly_denoised(even: Doubles, odd: Doubles, weights: Doubles, front: Flags) -> tuple[Doubles, Doubles]:
    """Shrinks the radiance of N Gaussians in D directions towards the mean over the directions of the same side.

    The variance of radiance over directions is that of the signal plus that of the noise. The difference between the
    two halves of the samples estimates the noise. The factor 1 - noise / variance keeps the signal (James and Stein
    1961). Sides with diffuse reflection become constant, highlights stay. Radiance is linear here, so that means are
    unbiased.

    Args:
        even: Linear radiance of the even samples, shape (N, D, 3).
        odd: Linear radiance of the odd samples, shape (N, D, 3).
        weights: Weights of the directions, shape (N, D).
        front: Directions that view the front, shape (N, D).

    Returns:
        The denoised radiance of the even and of the odd samples.
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
