"""Gaussians near each other, and means over those that face the same way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.sampling.blue_noise import Pairs, cross_pairs, pairs_of_about

NEIGHBOURS = 12
"""Gaussians, about, over which the light at a Gaussian is averaged: it changes less than its noise."""

NORMAL_SHARPNESS = 8
"""Exponent of the cosine between normals of those."""


def neighbours_of(gaussians: Gaussians) -> Pairs:
    """Pairs of Gaussians near each other, in both orders and with themselves, about `NEIGHBOURS` of each."""
    means = gaussians.means.astype(np.float64)
    return pairs_of_about(NEIGHBOURS, means, partial(cross_pairs, means, means))[0]


def normal_variances(gaussians: Gaussians, normals: Doubles, near: Pairs) -> Doubles:
    """By how much a surface turns within each Gaussian: variance of its normal along an axis, radians^2, shape (N,).

    Normals of neighbours on the same side turn by so much a distance, in the mean of squares; a Gaussian covers its
    two larger scales. Where nothing is near, it is 0.
    """
    first, second = (rows[near.first != near.second] for rows in (near.first, near.second))
    apart = np.square(gaussians.means[first].astype(np.float64) - gaussians.means[second]).sum(axis=1)
    cosines = np.clip(np.einsum("ij,ij->i", normals[first], normals[second]), 0.0, 1.0)
    turned = np.bincount(first, cosines * 2.0 * (1.0 - cosines), len(normals))
    distances = np.bincount(first, cosines * apart, len(normals))
    covered = np.sort(np.square(gaussians.scales.astype(np.float64)), axis=1)[:, 1:].mean(axis=1)
    return turned * covered / np.maximum(distances, 1e-6 * covered)


Values = TypeVar("Values", FloatArray, Doubles)


@dataclass(frozen=True, slots=True, eq=False)
class Smoother:
    """Means over neighbours that face the same way, lamps apart: light changes less among them than its noise."""

    near: Pairs
    weights: Doubles
    """Of each pair; they add up to 1 for the first one."""

    @staticmethod
    def of(near: Pairs, normals: Doubles, lamps: Rows) -> Smoother:
        """Of Gaussians with these normals, some of which are of lamps (-1: none)."""
        weights = np.maximum(np.einsum("ij,ij->i", normals[near.first], normals[near.second]), 0.0) ** NORMAL_SHARPNESS
        weights[(lamps[near.first] >= 0) != (lamps[near.second] >= 0)] = 0.0
        return Smoother(near, weights / np.bincount(near.first, weights, len(normals))[near.first])

    def mean(self, values: Values) -> Values:
        """Of each column, shape (N, C)."""
        smooth = np.empty_like(values)
        for column in range(values.shape[1]):
            weighted = self.weights * values[self.near.second, column]
            smooth[:, column] = np.bincount(self.near.first, weighted, len(values))
        return smooth

    def incident(self, incident: Irradiance) -> Irradiance:
        """Smooth light; what comes from each direction stays as it is."""
        smooth = {name: self.mean(getattr(incident, name)) for name in ("observed", "sky", "lamps")}
        return replace(incident, **smooth)
