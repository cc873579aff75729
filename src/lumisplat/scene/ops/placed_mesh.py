"""Meshes moved for good."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lumisplat.constants import ORIGIN_MESH_WIDTH
from lumisplat.math.transforms import transform_points
from lumisplat.scene.local_frame import needed_origin
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance


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
