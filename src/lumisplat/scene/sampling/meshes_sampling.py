"""Gaussians from several meshes that are one object: they share a count by area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lumisplat.constants import SAMPLING_COUNT_MAX
from lumisplat.errors import SceneError
from lumisplat.math.transforms import is_mirroring, transform_normals, transform_points
from lumisplat.scene.gaussians import Gaussians, merged
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.mesh_sampling import SurfaceSamples, default_count, sample_surface, surface_area
from lumisplat.scene.scene import MeshInstance


def sample_surfaces(meshes: Sequence[Mesh], count: int | None = None, seed: int = 0) -> list[SurfaceSamples]:
    """Gaussians of each mesh, in all ``count``.

    Args:
        meshes: At least one, in the same space.
        count: At least one for each mesh; None: as many as put neighbours 1/300 of the diagonal of all meshes'
            bounding box apart, from 1,000 to 1,000,000.
        seed: Seed of the random order.

    Raises:
        SceneError: ``count`` is out of range.
    """
    count = max(default_count(meshes), len(meshes)) if count is None else count
    whole = isinstance(count, int | np.integer) and not isinstance(count, bool)
    if not whole or not len(meshes) <= count <= SAMPLING_COUNT_MAX:
        raise SceneError(f"count is {count}, expected a whole number from {len(meshes)} to {SAMPLING_COUNT_MAX:,}")
    areas = np.array([surface_area(mesh) for mesh in meshes])
    ends = np.floor(np.cumsum(areas) / areas.sum() * (count - len(meshes)) + 0.5)
    shares = np.diff(ends, prepend=0.0).astype(int) + 1
    return [sample_surface(mesh, int(share), seed) for mesh, share in zip(meshes, shares, strict=True)]


def gaussians_from_instances(instances: Sequence[MeshInstance], count: int | None = None, seed: int = 0) -> Gaussians:
    """Covers placed meshes with Gaussians in world space; see `gaussians_from_mesh`.

    Raises:
        SceneError: There is no mesh, or ``count`` is out of range.
    """
    samples = sample_surfaces([_in_world(instance) for instance in instances], count, seed)
    return merged([one.gaussians for one in samples])


def _in_world(instance: MeshInstance) -> Mesh:
    mesh, matrix = instance.mesh, instance.transform[None, :3]
    return replace(
        mesh,
        positions=transform_points(matrix, mesh.positions),
        normals=None if mesh.normals is None else transform_normals(matrix, mesh.normals),
        indices=mesh.indices[:, ::-1] if is_mirroring(matrix) else mesh.indices,
    )
