"""Intervals of found materials: how far albedo and roughness may be from the truth (docs/method/delighting.md).

Sources of error are independent, so that their squares add up. The constants were fitted to captures of known
materials, so that nine tenths of the truth lie within the intervals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants import RADIANCE_LEAST
from lumisplat.math.arrays import Doubles, FloatArray, read_only_view
from lumisplat.relighting.roughness_fit import SAME_NORMALS
from lumisplat.scene.ops.neighbours import Pairs

DIM_MAX = 10.0
"""Ratio of the median Gaussian's light to a Gaussian's own above which the interval of its albedo stops growing."""

ROUGHNESS_SHARP, ROUGHNESS_SPAN = 0.2, 0.5
"""Roughness below which intervals do not widen, and roughness above it at which they stop widening."""


@dataclass(frozen=True, slots=True)
class AlbedoErrors:
    """Half widths of 90 % intervals of log albedo by source of error, whose squares add up."""

    least: float
    """Half width where no other source counts."""
    apart: float
    """Half width per difference of log albedo from the mean of the neighbours with similar normals."""
    dim: float
    """Half width per ratio of the median Gaussian's light to a Gaussian's own, minus 1; 0 where there is more light
    than at the median."""

    def of(self, albedo: Doubles, light: Doubles, normals: Doubles, near: Pairs) -> FloatArray:
        """Returns the half width of the 90 % interval of log albedo of N Gaussians, shape (N,).

        Args:
            albedo: Found albedo, shape (N, 3).
            light: Light at each Gaussian in any unit, such as the radiance of a white surface in its place, shape (N,).
            normals: Unit normals, shape (N, 3).
            near: Pairs of neighbouring Gaussians, in both orders and with themselves.
        """
        logs = np.log(np.maximum(albedo, RADIANCE_LEAST))
        weights = np.maximum(np.einsum("ij,ij->i", normals[near.first], normals[near.second]), 0.0) ** SAME_NORMALS
        total = np.bincount(near.first, weights, len(logs))
        around = [np.bincount(near.first, weights * channel[near.second], len(logs)) / total for channel in logs.T]
        apart = np.abs(logs - np.stack(around, axis=1)).mean(axis=1)
        dim = np.clip(float(np.median(light)) / np.maximum(light, RADIANCE_LEAST), 1.0, DIM_MAX) - 1.0
        squares = self.least**2 + np.square(self.apart * apart) + np.square(self.dim * dim)
        return read_only_view(np.sqrt(squares).astype(np.float32))


def roughness_error(roughness: Doubles | FloatArray, least: float, slope: float) -> FloatArray:
    """Returns the half width of the 90 % interval of N found roughnesses, shape (N,).

    The usual error is a sharp highlight that curvature, SH or few directions of light blur, so that the surface is
    taken for rougher than it is. The interval therefore widens with the roughness.

    Args:
        roughness: Found roughness, 0..1, shape (N,).
        least: Half width of the 90 % interval of the smallest roughness.
        slope: Half width per roughness above `ROUGHNESS_SHARP`.
    """
    above = np.clip(np.asarray(roughness, np.float64) - ROUGHNESS_SHARP, 0.0, ROUGHNESS_SPAN)
    return read_only_view(np.hypot(least, slope * above).astype(np.float32))
