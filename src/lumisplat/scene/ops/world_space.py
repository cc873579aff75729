"""Moves meshes and shapes of Gaussians to world space."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import ORIGIN_MESH_WIDTH
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.transforms import multiply_quaternions, quaternions_from_matrices, transform_points
from lumisplat.scene.local_frame import needed_origin
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, SplatInstance

ZERO: Doubles = np.zeros(3)
"""Zero of the world, as an origin."""

_STRAYS = 0.01
"""Share of a body's means on each side that its box leaves out."""


def placed_mesh(instance: MeshInstance) -> Mesh:
    """The mesh of an instance in world space; a mirrored one is wound the other way round."""
    mesh, linear = instance.mesh, instance.transform[:3, :3]
    if np.array_equal(instance.transform, np.eye(4)):
        return mesh
    flipped = np.linalg.det(linear) < 0.0
    positions = transform_points(instance.transform, mesh.positions)
    origin = needed_origin(positions, ORIGIN_MESH_WIDTH * float(np.ptp(positions, axis=0).max()))
    return replace(
        mesh,
        positions=(positions - origin).astype(np.float32),
        origin=tuple(origin.tolist()),
        normals=None if mesh.normals is None else (mesh.normals @ np.linalg.inv(linear)).astype(np.float32),
        indices=mesh.indices[:, ::-1] if flipped else mesh.indices,
    )


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


def placed_gaussians(instances: Iterable[SplatInstance], origin: Doubles = ZERO) -> PlacedGaussians:
    """The Gaussians of all instances, in order, in world space about an origin; empty if there is no instance."""
    empty = PlacedGaussians(*(np.empty((0, *shape), np.float32) for shape in ((3,), (4,), (3,), ())))
    parts = [empty, *(_in_world(instance, origin) for instance in instances)]
    return PlacedGaussians(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def distance_from_body(points: npt.NDArray[np.floating], gaussians: PlacedGaussians) -> npt.NDArray[np.floating]:
    """How far points are from the box of a body along x, y or z, whichever is farthest; 0 within.

    Args:
        points: World space, shape (P, 3).
        gaussians: The body, at least one Gaussian. A hundredth of the means on each side does not count: strays.

    Returns:
        Scene units, shape (P,).
    """
    low, high = np.quantile(gaussians.means, (_STRAYS, 1.0 - _STRAYS), axis=0)
    return np.maximum(np.maximum(low - points, points - high), 0.0).max(axis=1, initial=0.0)


def _in_world(instance: SplatInstance, origin: Doubles) -> PlacedGaussians:
    gaussians, matrix, scale = instance.gaussians, instance.transform, instance.scale
    if np.array_equal(matrix, np.eye(4)) and not origin.any():
        return PlacedGaussians(gaussians.means, gaussians.rotations_wxyz, gaussians.scales, gaussians.opacities)
    world_from_object = quaternions_from_matrices(matrix[None, :3, :3] / scale)[0]
    return PlacedGaussians(
        (instance.world_means - origin).astype(np.float32),
        multiply_quaternions(world_from_object, gaussians.rotations_wxyz).astype(np.float32),
        (gaussians.scales * scale).astype(np.float32),
        gaussians.opacities,
    )
