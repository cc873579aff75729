"""Gaussians on rays, one by one, and the part of a ray on which nothing else is (docs/method/relighting.md#baking)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants.baking import SPAN_PAST
from lumisplat.math.arrays import Doubles, Flags, IntArray
from lumisplat.renderer.ray_profiles import RayProfile

_Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class MetGaussians:
    """The Gaussians on P rays, S rows sorted by ray, each ray's in the order in which they are blended."""

    ray: _Rows
    """Shape (S,)."""
    gaussian: _Rows
    """Among all of the scene's, shape (S,)."""
    weight: Doubles
    """Share of it in what the ray shows, shape (S,)."""
    t: Doubles
    """Distance, scene units, shape (S,)."""
    rays: int

    @classmethod
    def of(cls, profile: RayProfile, firsts: IntArray) -> MetGaussians:
        """Those of a profile; ``firsts`` are the numbers of the first Gaussian of each instance."""
        return cls(
            ray=np.repeat(np.arange(len(profile)), np.diff(profile.first)),
            gaussian=firsts[profile.instance_index] + profile.gaussian_index.astype(np.int64),
            weight=(profile.transmittance * profile.alpha / (1.0 - profile.alpha)).astype(np.float64),
            t=profile.t.astype(np.float64),
            rays=len(profile),
        )

    def where(self, rows: Flags) -> MetGaussians:
        """Some of them, on the same rays."""
        return MetGaussians(self.ray[rows], self.gaussian[rows], self.weight[rows], self.t[rows], self.rays)

    def total(self, values: Doubles | Flags) -> Doubles:
        """Weighted sums of values of the rows over each ray, shape (P,)."""
        return np.bincount(self.ray, self.weight * values, self.rays).astype(np.float64)


def clear_spans(met: MetGaussians, wanted: Flags, before_mesh: Flags) -> tuple[Doubles, Doubles, Flags]:
    """The part of each ray around what it shows most of, on which nothing but wanted Gaussians is.

    Args:
        met: The Gaussians on the rays.
        wanted: Which rows are of these, shape (S,).
        before_mesh: Which rays meet a mesh behind all of them, shape (P,).

    Returns:
        Where it begins and where it ends, shape (P,) each: 0 and infinity where the ray meets nothing else, else half
        way between what is wanted and what is not; and which rows are within, shape (S,). A ray that nothing is left
        of ends where it begins.
    """
    ray, t = met.ray, met.t
    most, middle = np.zeros(met.rays), np.zeros(met.rays)
    np.maximum.at(most, ray[wanted], met.weight[wanted])
    heaviest = wanted & (met.weight == most[ray])
    middle[ray[heaviest]] = t[heaviest]
    before, behind = ~wanted & (t < middle[ray]), ~wanted & (t >= middle[ray])
    low, high = np.zeros(met.rays), np.full(met.rays, np.inf)
    np.maximum.at(low, ray[before], t[before])
    np.minimum.at(high, ray[behind], t[behind])
    within = wanted & (t > low[ray]) & (t < high[ray])
    first, last = np.full(met.rays, np.inf), np.zeros(met.rays)
    np.minimum.at(first, ray[within], t[within])
    np.maximum.at(last, ray[within], t[within])
    begin = np.where(low > 0.0, 0.5 * (low + first), 0.0)
    end = np.where(np.isfinite(high), 0.5 * (high + last), np.where(before_mesh, (1.0 + SPAN_PAST) * last, np.inf))
    empty = np.isinf(first)
    return np.where(empty, 0.0, begin), np.where(empty, 0.0, end), within
