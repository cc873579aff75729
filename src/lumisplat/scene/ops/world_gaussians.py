"""Gaussians in world space: their shapes, without colours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import FloatArray
from lumisplat.math.rotations import multiply_quaternions, quaternions_from_matrices
from lumisplat.scene.scene import SplatInstance


class PlacedGaussians(NamedTuple):
    """Gaussians in world space, as float32."""

    means: FloatArray
    """Shape (N, 3)."""
    rotations_wxyz: FloatArray
    """World from Gaussian, unit quaternions, shape (N, 4)."""
    scales: FloatArray
    """Standard deviations, shape (N, 3)."""
    opacities: FloatArray
    """0..1, shape (N,)."""

    @property
    def rotations_xyzw(self) -> FloatArray:
        """The rotations in the order of Warp's quaternions, shape (N, 4)."""
        return self.rotations_wxyz[:, [1, 2, 3, 0]]


def placed_gaussians(instances: Iterable[SplatInstance]) -> PlacedGaussians:
    """The Gaussians of all instances, in order, in world space; empty arrays if there is no instance."""
    empty = PlacedGaussians(*(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), ())))
    parts = [empty, *(_in_world(instance) for instance in instances)]
    return PlacedGaussians(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def center_of(gaussians: PlacedGaussians) -> npt.NDArray[np.floating]:
    """Mean position, weighted by opacity, shape (3,)."""
    # Fully transparent Gaussians still have a position: their weights must not sum to 0.
    return np.average(gaussians.means, axis=0, weights=gaussians.opacities + 1e-9)


def _in_world(instance: SplatInstance) -> PlacedGaussians:
    gaussians, matrix, scale = instance.gaussians, instance.transform, instance.scale
    if np.array_equal(matrix, np.eye(4)):
        return PlacedGaussians(gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities)
    world_from_object = quaternions_from_matrices(matrix[None, :3, :3] / scale)[0]
    return PlacedGaussians(
        instance.world_means.astype(np.float32),
        multiply_quaternions(world_from_object, gaussians.rotations_wxyz).astype(np.float32),
        (gaussians.scales * scale).astype(np.float32),
        gaussians.opacities,
    )
