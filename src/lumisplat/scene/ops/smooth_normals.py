"""Normals of meshes that come without: smooth across blunt edges, broken at sharp ones."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import CREASE_ANGLE, WELD_SHARE
from lumisplat.errors import SceneError
from lumisplat.scene.checks import check_argument
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.triangles import area_vectors


def smooth_normals(mesh: Mesh, crease_angle: float = CREASE_ANGLE) -> Mesh:
    """The mesh with new normals: at a corner, the mean of the faces around that meet its own at less than an angle.

    Faces count by their angle at the corner (Thuermer and Wuethrich 1998), so that how they are cut into triangles does
    not matter; corners at the same place are one, whatever their uvs. Where corners of a vertex get different normals,
    it is split.

    Args:
        mesh: The mesh; normals that it has are replaced.
        crease_angle: Largest angle between faces that are smooth, radians, 0 to pi; 0: flat.

    Raises:
        SceneError: It is no mesh, or the angle is out of range.
    """
    check_argument("smooth_normals", mesh, Mesh, "a Mesh")
    if not is_number(crease_angle) or not 0.0 <= crease_angle <= math.pi:
        raise SceneError(f"crease_angle is {crease_angle}, expected radians from 0 to pi")
    if crease_angle == 0.0:
        return replace(mesh, normals=None)
    normals = _corner_normals(mesh, crease_angle)
    # Corners of a vertex whose normals are equal stay one vertex.
    cells: npt.NDArray[np.int64] = np.rint(normals * 1e5).astype(np.int64)
    keys = np.column_stack([mesh.indices.ravel(), cells])
    _, first, vertex = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    old = mesh.indices.ravel()[first]
    return replace(
        mesh,
        positions=mesh.positions[old],
        indices=vertex.reshape(-1, 3),
        normals=normals[first],
        uvs=None if mesh.uvs is None else mesh.uvs[old],
        colors=None if mesh.colors is None else mesh.colors[old],
    )


def _corner_normals(mesh: Mesh, crease_angle: float) -> np.ndarray:
    """Unit normals of the triangles' corners, one row a corner, shape (3 F, 3)."""
    areas = area_vectors(mesh.positions, mesh.indices)
    faces = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-300)
    low, high = mesh.bounds()
    cell = WELD_SHARE * float(np.linalg.norm(high.astype(np.float64) - low))
    welded = np.round(mesh.positions.astype(np.float64) / cell)
    _, point = np.unique(welded, axis=0, return_inverse=True)
    point_of_corner = point.reshape(-1)[mesh.indices].ravel()
    face_of_corner = np.repeat(np.arange(len(faces)), 3)
    angle_of_corner = _corner_angles(mesh).ravel()
    normals = np.zeros((len(point_of_corner), 3))
    cosine = math.cos(crease_angle) - 1e-6
    order = np.argsort(point_of_corner, kind="stable")
    starts = np.flatnonzero(np.diff(point_of_corner[order], prepend=-1))
    counts = np.diff(starts, append=len(order))
    for count in np.unique(counts):  # all points with as many corners at once: pairs are count x count
        rows = order[starts[counts == count][:, None] + np.arange(count)]
        around = faces[face_of_corner[rows]]
        weights = angle_of_corner[rows][:, None, :] * (np.einsum("nic,njc->nij", around, around) >= cosine)
        normals[rows] = np.einsum("nij,njc->nic", weights, around)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    flat = lengths[:, 0] <= 1e-12
    normals /= np.maximum(lengths, 1e-300)
    normals[flat] = faces[face_of_corner[flat]]
    return normals


def _corner_angles(mesh: Mesh) -> np.ndarray:
    """Angles of the triangles at their corners, radians, shape (F, 3)."""
    corners = mesh.positions.astype(np.float64)[mesh.indices]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(one, other), axis=2)
    return np.arctan2(sine, np.einsum("fkc,fkc->fk", one, other))
