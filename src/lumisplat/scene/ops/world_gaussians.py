"""Gaussians where they stand in the world: their shapes, without colours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import FloatArray
from lumisplat.math.rotations import quaternions_from_matrices
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


def placed_gaussians(instances: Iterable[SplatInstance]) -> PlacedGaussians:
    """The Gaussians of all instances, in order, where they stand; of no instance, empty arrays."""
    empty = tuple(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), ()))
    parts = [empty, *(_placed(instance) for instance in instances)]
    return PlacedGaussians(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def center_of(placed: PlacedGaussians) -> npt.NDArray[np.floating]:
    """Mean of the Gaussians, weighted by opacity, shape (3,)."""
    # All transparent: they have a place nevertheless.
    return np.average(placed.means, axis=0, weights=placed.opacities + 1e-9)


def _placed(instance: SplatInstance) -> tuple[FloatArray, ...]:
    gaussians, matrix, scale = instance.gaussians, instance.transform, instance.scale
    if np.array_equal(matrix, np.eye(4)):
        return gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities
    means = instance.world_means
    turned = _product(quaternions_from_matrices(matrix[None, :3, :3] / scale)[0], gaussians.rotations_wxyz)
    scales = gaussians.scales * scale
    return means.astype(np.float32), turned.astype(np.float32), scales.astype(np.float32), gaussians.opacities


def _product(left: npt.NDArray[np.floating], right: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Hamilton's product of one quaternion (4,) with each of many (N, 4)."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ matrix.T
