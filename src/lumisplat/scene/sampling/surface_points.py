"""Points on the triangles of a mesh, stratified by area: the candidates for the centres of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SAMPLING_DEFAULT_COUNTS, SAMPLING_SPACINGS_PER_DIAGONAL
from lumisplat.math.arrays import Doubles
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.triangles import area_vectors


class SurfacePoints(NamedTuple):
    """M points on triangles."""

    positions: Doubles
    """Shape (M, 3)."""
    faces: npt.NDArray[np.integer]
    """Triangle of each point, shape (M,)."""
    weights: Doubles
    """Barycentric coordinates, shape (M, 3)."""

    def at(self, rows: npt.NDArray[np.integer]) -> SurfacePoints:
        """The points that ``rows`` selects."""
        return SurfacePoints(self.positions[rows], self.faces[rows], self.weights[rows])


def face_areas_and_normals(mesh: Mesh) -> tuple[Doubles, Doubles]:
    """Areas of the triangles, shape (F,), and their unit normals (0 without an area), shape (F, 3)."""
    vectors = area_vectors(mesh.positions, mesh.indices)
    doubled = np.linalg.norm(vectors, axis=1)
    normals = np.divide(vectors, doubled[:, None], out=np.zeros_like(vectors), where=doubled[:, None] > 0.0)
    return 0.5 * doubled, normals


def surface_area(mesh: Mesh) -> float:
    """Sum of the areas of all triangles, square scene units."""
    return float(face_areas_and_normals(mesh)[0].sum())


def default_count(meshes: Sequence[Mesh]) -> int:
    """Number of Gaussians for which neighbours are 1/300 of the diagonal of the meshes' bounding box apart."""
    corners = [mesh.positions[mesh.indices].reshape(-1, 3).astype(np.float64) for mesh in meshes]
    highest, lowest = (np.array([extreme(c, axis=0) for c in corners]) for extreme in (np.max, np.min))
    diagonal = float(np.linalg.norm(highest.max(axis=0) - lowest.min(axis=0)))
    ideal = sum(map(surface_area, meshes)) / (diagonal / SAMPLING_SPACINGS_PER_DIAGONAL) ** 2
    return int(np.clip(math.ceil(ideal), *SAMPLING_DEFAULT_COUNTS))


def stratified_points(mesh: Mesh, areas: Doubles, count: int, rng: np.random.Generator) -> SurfacePoints:
    """Points stratified by area over the triangles, and by the R2 sequence (Roberts 2018) within each triangle."""
    cumulative = np.cumsum(areas)
    strata: Doubles = (np.arange(count) + rng.random(count)) * (cumulative[-1] / count)
    faces = np.minimum(np.searchsorted(cumulative, strata, side="right"), np.flatnonzero(areas)[-1])
    plastic = 1.3247179572447460
    steps = np.arange(count)[:, None] * np.array([1.0 / plastic, 1.0 / plastic**2])
    jitter = 0.7 * rng.random((count, 2)) / np.sqrt(np.bincount(faces, minlength=areas.size)[faces])[:, None]
    uv = (steps + jitter) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1.0, 1.0 - uv, uv)
    weights = np.concatenate([1.0 - uv.sum(axis=1, keepdims=True), uv], axis=1)
    positions = interpolate_vertices(mesh.positions.astype(np.float64), mesh.indices[faces], weights)
    return SurfacePoints(positions, faces, weights)


def interpolate_vertices(
    values: npt.NDArray[np.floating], corners: npt.NDArray[np.integer], weights: npt.NDArray[np.floating]
) -> Doubles:
    """Interpolates vertex values, shape (V, D), at points on triangles.

    Args:
        values: Shape (V, D).
        corners: Vertices of the triangle of each point, shape (M, 3).
        weights: Barycentric coordinates of the points, shape (M, 3).

    Returns:
        Shape (M, D).
    """
    interpolated = np.zeros((len(corners), values.shape[1]))
    for corner in range(3):
        interpolated += weights[:, corner, None] * values[corners[:, corner]]
    return interpolated
