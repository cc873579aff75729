"""Outward normals of Gaussians that have none."""

from __future__ import annotations

from lumisplat.config_relight import NormalEstimate
from lumisplat.scene.arrays import FloatArray
from lumisplat.scene.gaussians import Gaussians


def estimate_normals(gaussians: Gaussians, method: NormalEstimate = NormalEstimate.AUTO) -> FloatArray:
    """Unit outward normals of a set, in its own space, shape (N, 3)."""
    raise NotImplementedError
