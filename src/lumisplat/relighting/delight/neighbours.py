"""Gaussians near each other, and means over those that face the same way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lumisplat.constants.delight import NEIGHBOURS, NORMAL_SHARPNESS
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.relighting.delight.incident import Incident
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.sampling.blue_noise import Pairs, cross_pairs


def neighbours_of(gaussians: Gaussians) -> Pairs:
    """Pairs of Gaussians near each other, in both orders and with themselves, about `NEIGHBOURS` of each."""
    means = gaussians.means.astype(np.float64)
    low, high = np.quantile(means, [0.25, 0.75], axis=0)
    radius = max(float(np.linalg.norm(high - low)) * np.sqrt(NEIGHBOURS / len(means)), 1e-9)
    pairs = cross_pairs(means, means, radius)
    for _ in range(4):
        degree = max(float(np.median(np.bincount(pairs.first, minlength=len(means)))), 1.0)
        if 0.7 < degree / NEIGHBOURS < 1.6:
            break
        radius *= float(np.clip(np.sqrt(NEIGHBOURS / degree), 0.25, 3.0))
        pairs = cross_pairs(means, means, radius)
    return pairs


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

    def incident(self, incident: Incident) -> Incident:
        """Smooth light."""
        return Incident(self.mean(incident.observed), self.mean(incident.sky), self.mean(incident.lamps))
