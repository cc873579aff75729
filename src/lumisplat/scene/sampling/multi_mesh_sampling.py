"""Gaussians from several meshes that are one object: a total count, divided by area."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lumisplat.constants import SAMPLING_COUNT_MAX
from lumisplat.math.transforms import is_mirroring, transform_normals_each, transform_points_each
from lumisplat.scene.checks import check_whole
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.mesh_sampling import SurfaceSamples, sample_surface
from lumisplat.scene.sampling.surface_points import default_count, surface_area
from lumisplat.scene.scene import MeshInstance


def sample_surfaces(meshes: Sequence[Mesh], count: int | None = None, seed: int = 0) -> list[SurfaceSamples]:
    """Gaussians of each mesh, ``count`` in total.

    Args:
        meshes: At least one mesh, all in the same space.
        count: At least one for each mesh; None: so many that neighbours are 1/300 of the diagonal of the common
            bounding box apart, from 1,000 to 1,000,000.
        seed: Seed of the random order.

    Raises:
        SceneError: ``count`` is out of range.
    """
    count = max(default_count(meshes), len(meshes)) if count is None else count
    check_whole("count", count, len(meshes), SAMPLING_COUNT_MAX)
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
    return merge_gaussians([one.gaussians for one in samples])


def _in_world(instance: MeshInstance) -> Mesh:
    mesh, matrix = instance.mesh, instance.transform[None, :3]
    return replace(
        mesh,
        positions=transform_points_each(matrix, mesh.positions),
        normals=None if mesh.normals is None else transform_normals_each(matrix, mesh.normals),
        indices=mesh.indices[:, ::-1] if is_mirroring(matrix) else mesh.indices,
    )
