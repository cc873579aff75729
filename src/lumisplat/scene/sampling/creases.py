"""Creases of a mesh: points along its sharp and open edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import CREASE_COSINE
from lumisplat.math.arrays import IntArray
from lumisplat.scene.mesh import Mesh


class CreasePoints(NamedTuple):
    """C points along creases."""

    positions: npt.NDArray[np.float64]
    """Shape (C, 3)."""
    directions: npt.NDArray[np.float64]
    """Unit direction of the edge at each point, shape (C, 3)."""


def crease_points(mesh: Mesh, face_normals: npt.NDArray[np.floating], spacing: float, *, limit: int) -> CreasePoints:
    """Points at most ``spacing`` apart along all open, non-manifold and sharp edges.

    Args:
        mesh: The mesh; vertices at equal positions count as one.
        face_normals: Unit normals, shape (F, 3); zero for faces without area.
        spacing: Largest distance between neighbours on an edge, scene units, > 0.
        limit: Largest number of points; ``spacing`` grows to keep it.
    """
    start, end = _crease_edges(mesh, face_normals)
    lengths: npt.NDArray[np.float64] = np.linalg.norm(end - start, axis=1)
    spacing = max(spacing, float(lengths.sum()) / limit)
    counts = np.ceil(lengths / spacing).astype(np.int64)
    edge = np.repeat(np.arange(counts.size), counts)
    step = np.arange(edge.size) - np.repeat(np.cumsum(counts) - counts, counts)
    along = (step + 0.5) / counts[edge]
    positions = start[edge] + (end - start)[edge] * along[:, None]
    # Dense meshes have many short edges: one point per voxel is enough.
    _, rows = np.unique(np.floor(positions / (0.5 * spacing)).astype(np.int64), axis=0, return_index=True)
    return CreasePoints(positions[rows], ((end - start) / lengths[:, None])[edge[rows]])


def welded_indices(mesh: Mesh) -> IntArray:
    """Triangles over unique positions: vertices that were split for normals or uvs are joined again, shape (F, 3)."""
    _, unique_from_vertex = np.unique(mesh.positions, axis=0, return_inverse=True)
    return unique_from_vertex.reshape(-1).astype(np.int32)[mesh.indices]


def _crease_edges(
    mesh: Mesh, face_normals: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Start and end points of the open, non-manifold and sharp edges, shape (E, 3) each."""
    faces = np.flatnonzero(np.linalg.norm(face_normals, axis=1) > 0.5)
    corners = welded_indices(mesh)[faces]
    ends = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    vertices = np.concatenate([mesh.indices[faces][:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    normals = np.tile(face_normals[faces], (3, 1))
    key = ends.min(axis=1).astype(np.int64) * (corners.max() + 1) + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    _, starts, counts = np.unique(key[order], return_index=True, return_counts=True)
    one, other = order[starts], order[starts + (counts == 2)]
    cosines = np.einsum("ij,ij->i", normals[one], normals[other])
    sharp = one[(counts != 2) | (cosines < CREASE_COSINE)]
    start, end = (mesh.positions[vertices[sharp, k]].astype(np.float64) for k in (0, 1))
    has_length = (start != end).any(axis=1)
    return start[has_length], end[has_length]
