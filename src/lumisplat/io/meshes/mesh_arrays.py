"""What the mesh formats share: polygons to triangles, texture axes, unit normals, textures that nothing can place."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.triangles import check_triangles, problems

_log = logging.getLogger("lumisplat")


@dataclass(slots=True)
class TriangleSieve:
    """Leaves out the triangles of a file that no mesh can use, and counts them over all of its meshes."""

    path: PathLike
    out_of_range: int = 0
    without_area: int = 0

    def usable(self, positions: npt.NDArray[np.float32], indices: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """Which triangles to keep, shape (F,).

        Args:
            positions: Shape (V, 3).
            indices: Triangles, shape (F, 3).
        """
        check = check_triangles(positions, indices)
        self.out_of_range += check.out_of_range
        self.without_area += check.without_area
        return check.usable

    @property
    def problems(self) -> str:
        """What was left out so far, counted, in one phrase; empty for nothing."""
        return problems(self.out_of_range, self.without_area)

    def report(self, anything_left: bool) -> None:
        """Logs what was left out, in one line, if anything was.

        Raises:
            FormatError: Nothing is left.
        """
        if not anything_left:
            raise FormatError(self.path, f"has no triangles{self.problems and ' but ' + self.problems}")
        if self.problems:
            _log.warning("%s: triangles left out: %s", os.fspath(self.path), self.problems)


def fan_triangles(corner_counts: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Splits polygons into fans around their first corner.

    Args:
        corner_counts: Corners of each polygon, shape (P,); fewer than 3 (points, lines) give no triangle.

    Returns:
        Triangles as indices into the concatenated corners of all polygons, shape (F, 3).
    """
    counts = np.asarray(corner_counts, dtype=np.int64)
    starts = np.cumsum(counts) - counts
    fans = np.maximum(counts - 2, 0)
    first = np.repeat(starts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)


def flip_v(uvs: npt.NDArray) -> npt.NDArray[np.float32]:
    """Texture coordinates between a bottom-left origin (OBJ, PLY) and our top-left one, shape (V, 2)."""
    return np.stack([uvs[:, 0], 1.0 - uvs[:, 1].astype(np.float64)], axis=1).astype(np.float32)


def unit_normals(
    normals: npt.NDArray[np.floating], positions: npt.NDArray[np.floating], indices: npt.NDArray[np.integer]
) -> npt.NDArray[np.float32]:
    """Normals at length 1; where a file stores a zero one, the area-weighted mean of the adjacent triangles.

    Args:
        normals: As stored, shape (V, 3).
        positions: Shape (V, 3).
        indices: Triangles whose vertices exist, shape (F, 3).

    Returns:
        Shape (V, 3), float32; +z where no triangle is around.
    """
    normals = np.array(normals, dtype=np.float64)
    missing = np.linalg.norm(normals, axis=1) == 0.0
    if missing.any():
        a, b, c = (positions[indices[:, k]].astype(np.float64) for k in range(3))
        doubled_area = np.cross(b - a, c - a)
        smooth = np.zeros_like(normals)
        for k in range(3):
            np.add.at(smooth, indices[:, k], doubled_area)
        smooth[np.linalg.norm(smooth, axis=1) == 0.0] = (0.0, 0.0, 1.0)
        normals[missing] = smooth[missing]
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


def without_loose_textures(path: PathLike, mesh: Mesh) -> Mesh:
    """The mesh; without its textures, and a log line that says so, if it has no texture coordinates to place them."""
    material = placed_material(path, mesh.material, mesh.uvs, mesh.name)
    return mesh if material is mesh.material else replace(mesh, material=material)


def placed_material(path: PathLike, material: Material, uvs: FloatArray | None, name: str) -> Material:
    """The material of a mesh, as `without_loose_textures`.

    Args:
        path: For the log line.
        material: As the file has it.
        uvs: The mesh's texture coordinates.
        name: The mesh's.
    """
    names = [field.name for field in fields(material) if field.name.endswith("_texture")]
    loose = [texture for texture in names if getattr(material, texture) is not None]
    if not loose or uvs is not None:
        return material
    called = material.name or name
    said = f"the texture of {called!r} is" if len(loose) == 1 else f"the {len(loose)} textures of {called!r} are"
    _log.warning("%s: %s left out: there are no texture coordinates for it", os.fspath(path), said)
    return replace(material, **dict.fromkeys(loose))
