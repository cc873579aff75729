"""Helpers for all mesh formats: usable triangles, polygon fans, texture coordinates, normals, origins."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.constants import ORIGIN_MESH_WIDTH
from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.checks import with_checked
from lumisplat.scene.local_frame import needed_origin
from lumisplat.scene.materials import Material, texture_names
from lumisplat.scene.mesh import Mesh, area_vectors, check_triangles, describe_problems, sum_at_vertices
from lumisplat.scene.placing import Vector

_log = logging.getLogger("lumisplat")


_UNIT_ERROR = 1e-6
"""Deviation from length 1 up to which a stored normal is used unchanged; others are normalized."""


@dataclass(slots=True)
class TriangleSieve:
    """Finds the usable triangles of all meshes of a file, and counts the unusable ones.

    A triangle is usable if its vertex indices are valid and its area is above 0.
    """

    path: PathLike
    out_of_range: int = 0
    without_area: int = 0

    def usable(self, positions: npt.NDArray[np.float32], indices: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Returns a mask of the usable triangles, and counts the unusable ones.

        Args:
            positions: Positions of V vertices, shape (V, 3).
            indices: Vertex indices of F triangles, shape (F, 3).

        Returns:
            True for each usable triangle, shape (F,).
        """
        check = check_triangles(positions, indices)
        self.out_of_range += check.out_of_range
        self.without_area += check.without_area
        return check.usable

    @property
    def problems(self) -> str:
        """Phrase that counts the unusable triangles so far; empty if there are none."""
        return describe_problems(self.out_of_range, self.without_area)

    def report(self, any_usable: bool) -> None:
        """Logs how many triangles were unusable; nothing if none was.

        Args:
            any_usable: Whether the file has at least one usable triangle.

        Raises:
            FormatError: ``any_usable`` is False.
        """
        if not any_usable:
            raise FormatError(self.path, f"has no usable triangles{self.problems and ': ' + self.problems}")
        if self.problems:
            _log.warning("%s: triangles left out: %s", os.fspath(self.path), self.problems)


def fan_triangles(corner_counts: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Splits each polygon into a triangle fan around the polygon's first corner.

    Args:
        corner_counts: Number of corners of each of P polygons, shape (P,). Polygons with fewer than 3 corners (points,
            lines) give no triangle.

    Returns:
        F triangles as indices into the concatenated corners of all polygons, shape (F, 3).
    """
    counts = np.asarray(corner_counts, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    first = np.repeat(starts, fans)
    step = np.arange(int(fans.sum())) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def flip_v(uvs: npt.NDArray[np.floating]) -> FloatArray:
    """Flips texture coordinates, shape (V, 2), between a bottom-left origin (OBJ, PLY, USD) and a top-left origin."""
    return np.stack([uvs[:, 0], 1.0 - uvs[:, 1].astype(np.float64)], axis=1).astype(np.float32)


def unit_normals(
    normals: npt.NDArray[np.floating], positions: npt.NDArray[np.floating], indices: npt.NDArray[np.integer]
) -> FloatArray:
    """Returns unit normals. A zero normal becomes the area-weighted mean of the adjacent triangles' normals.

    Normals that have unit length up to rounding are unchanged.

    Args:
        normals: Normals of V vertices as stored, shape (V, 3).
        positions: Positions of the vertices, shape (V, 3).
        indices: Valid vertex indices of F triangles, shape (F, 3).

    Returns:
        Unit normals, shape (V, 3); +z if a vertex has a zero normal and no adjacent triangle.
    """
    stored, normals = normals, np.array(normals, dtype=np.float64)
    missing = np.linalg.norm(normals, axis=1) == 0.0
    if missing.any():
        smooth = sum_at_vertices(area_vectors(positions, indices), indices, len(normals))
        smooth[np.linalg.norm(smooth, axis=1) == 0.0] = (0.0, 0.0, 1.0)
        normals[missing] = smooth[missing]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Unit normals keep their bits: a mesh that is written and read again must not drift.
    is_unit = (np.abs(length - 1.0) < _UNIT_ERROR) & ~missing[:, None]
    return np.where(is_unit, stored, normals / length).astype(np.float32)


def drop_textures_without_uvs(path: PathLike, mesh: Mesh) -> Mesh:
    """Returns a mesh without its textures if it has no texture coordinates, and logs the loss."""
    material = material_for_uvs(path, mesh.material, mesh.uvs, mesh.name)
    return mesh if material is mesh.material else with_checked(mesh, material=material)


def material_for_uvs(path: PathLike, material: Material, uvs: FloatArray | None, name: str) -> Material:
    """Returns a material, without its textures if the mesh has no texture coordinates, and logs the loss.

    Args:
        path: The file, named in the log.
        material: Material of the file.
        uvs: Texture coordinates of the mesh.
        name: Name of the mesh, which the log line uses if the material has no name.
    """
    unusable = [texture for texture in texture_names(material) if getattr(material, texture) is not None]
    if not unusable or uvs is not None:
        return material
    label = repr(material.name or name)
    what = f"the texture of {label} is" if len(unusable) == 1 else f"the {len(unusable)} textures of {label} are"
    _log.warning("%s: %s left out: the mesh has no texture coordinates", os.fspath(path), what)
    return replace(material, **dict.fromkeys(unusable))


def relative_to_origin(path: PathLike, positions: npt.NDArray[np.floating]) -> tuple[FloatArray, Vector]:
    """Returns float32 positions relative to an origin, and the origin: zero if float32 is precise enough without one.

    An origin other than zero is logged.

    Args:
        path: The file, named in the log.
        positions: Positions as stored, shape (V, 3). Float32 positions are unchanged and have origin zero.
    """
    if positions.dtype == np.float32 or not len(positions):
        return positions.astype(np.float32), (0.0, 0.0, 0.0)
    with np.errstate(all="ignore"):  # values beyond float32 are refused later
        origin = needed_origin(positions.astype(np.float64), ORIGIN_MESH_WIDTH * float(np.ptp(positions, axis=0).max()))
        moved = (positions - origin).astype(np.float32)
    x, y, z = origin.tolist()
    if origin.any():
        _log.warning(
            "%s: positions are relative to the origin %.12g %.12g %.12g, because float32 is too coarse at such "
            "coordinates: the mesh is placed there unless a placement is given",
            os.fspath(path),
            *(x, y, z),
        )
    return moved, (x, y, z)
