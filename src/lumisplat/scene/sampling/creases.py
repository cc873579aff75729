"""Where a mesh is not smooth: points along its sharp and open edges."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import CREASE_COSINE
from lumisplat.math.arrays import IntArray
from lumisplat.scene.mesh import Mesh


class CreasePoints(NamedTuple):
    """Points along creases, shape (C, 3), with the unit direction of the edge at each, shape (C, 3)."""

    positions: npt.NDArray[np.float64]
    directions: npt.NDArray[np.float64]


def crease_points(mesh: Mesh, face_normals: npt.NDArray[np.floating], spacing: float, *, limit: int) -> CreasePoints:
    """Points not further than ``spacing`` apart along all open, non-manifold and sharp edges.

    Args:
        mesh: Triangles; vertices at equal positions count as one.
        face_normals: Unit normals, shape (F, 3); zero where a face has no area.
        spacing: Largest distance between neighbours on an edge, scene units, > 0.
        limit: Where it would take more points than this, ``spacing`` grows.
    """
    start, end = _crease_edges(mesh, face_normals)
    lengths = np.linalg.norm(end - start, axis=1)
    spacing = max(spacing, float(lengths.sum()) / limit)
    counts = np.ceil(lengths / spacing).astype(np.int64)
    edge = np.repeat(np.arange(counts.size), counts)
    step = np.arange(edge.size) - np.repeat(np.cumsum(counts) - counts, counts)
    along = (step + 0.5) / counts[edge]
    positions = start[edge] + (end - start)[edge] * along[:, None]
    # Dense meshes have many short edges: one point a voxel is enough.
    _, rows = np.unique(np.floor(positions / (0.5 * spacing)).astype(np.int64), axis=0, return_index=True)
    return CreasePoints(positions[rows], ((end - start) / lengths[:, None])[edge[rows]])


def welded_indices(mesh: Mesh) -> IntArray:
    """Triangles over unique positions: vertices split for normals or uvs become one again, shape (F, 3)."""
    _, unique_from_vertex = np.unique(mesh.positions, axis=0, return_inverse=True)
    return unique_from_vertex.reshape(-1).astype(np.int32)[mesh.indices]


def _crease_edges(
    mesh: Mesh, face_normals: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
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
    lasting = (start != end).any(axis=1)
    return start[lasting], end[lasting]
