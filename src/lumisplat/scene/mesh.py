"""Triangle meshes with one material, and operations on triangles: validity, areas, sums at vertices."""

from __future__ import annotations

import logging
from dataclasses import field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.setting import frozen, given
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import (
    FloatArray,
    IntArray,
    box_text,
    host_array,
    normalise_rows,
    read_only_array,
    read_only_view,
    refuse_outside_unit,
    to_floats,
    to_floats_or_none,
)
from lumisplat.scene.checks import take_scene_fields
from lumisplat.scene.lights import to_vector
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.placing import Vector

_log = logging.getLogger("lumisplat")


def _to_indices(values: npt.ArrayLike, name: str = "indices") -> IntArray:
    """Converts a user's triangles to a NumPy array; the mesh checks their type and shape later."""
    return np.asarray(host_array(values))


@frozen(weakref_slot=True)
class Mesh:
    """A mesh of V vertices and F triangles, counter-clockwise seen from outside.

    Arrays become read-only; an array that already is read-only and of the right type is not copied. Normals are
    normalised; a normal of zero length becomes the area-weighted mean of the adjacent faces' normals. Triangles without
    area or with an index out of range are left out, and a warning counts them; all vertices stay.

    Raises:
        SceneError: Shapes do not match, values are not finite, a colour is outside 0..1, indices are not integers, or
            no usable triangle is left.
    """

    positions: FloatArray = given(converter=to_floats)
    """Vertex positions, object space, scene units, shape (V, 3)."""
    indices: IntArray = given(converter=_to_indices)
    """Vertex indices of the triangles, shape (F, 3)."""
    normals: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Unit shading normals, object space, shape (V, 3); None: flat shading."""
    uvs: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Texture coordinates, (0, 0) at the top left as in glTF, shape (V, 2)."""
    material: Material = field(default_factory=MaterialPbr)
    colors: FloatArray | None = given(converter=to_floats_or_none, default=None)
    """Linear Rec.709 vertex colours, 0..1, multiplied with the base colour, shape (V, 3)."""
    name: str = ""
    origin: Vector = given(converter=to_vector, default=(0.0, 0.0, 0.0), kw_only=True)
    """World position of the mesh's coordinate origin, float64; a transform given to an instance replaces it."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        check_shapes(
            positions=(self.positions, "V 3"),
            normals=(self.normals, "V 3"),
            uvs=(self.uvs, "V 2"),
            colors=(self.colors, "V 3"),
        )
        if self.colors is not None:
            refuse_outside_unit("colors", self.colors)
        object.__setattr__(self, "indices", self._usable_triangles(self.indices))
        if self.normals is not None:
            object.__setattr__(self, "normals", normalise_rows("normals", self._fill_normals(self.normals)))

    def __repr__(self) -> str:
        extras = "".join(f", {name}" for name in ("normals", "uvs", "colors") if getattr(self, name) is not None)
        counts = f"vertices={self.vertex_count}, faces={self.face_count}, bounds={box_text(*self.bounds())}"
        if any(self.origin):
            counts += f", origin=({', '.join(f'{value:.12g}' for value in self.origin)})"
        return f"Mesh(name={self.name!r}, {counts}{extras})"

    @property
    def vertex_count(self) -> int:
        """Number of vertices, V."""
        return self.positions.shape[0]

    @property
    def face_count(self) -> int:
        """Number of triangles, F."""
        return self.indices.shape[0]

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Corners (min, max) of the bounding box, object space, shape (3,) each."""
        return self.positions.min(axis=0), self.positions.max(axis=0)

    def _usable_triangles(self, indices: npt.NDArray[Any]) -> IntArray:
        check = check_triangles(self.positions, indices)
        if not check.usable.any():
            raise SceneError(f"the mesh has no triangles{check.problems and ' but ' + check.problems}")
        if check.problems:
            _log.warning("mesh %r: triangles left out: %s", self.name, check.problems)
            indices = read_only_view(indices[check.usable])
        return read_only_array(indices, np.int32)

    def _fill_normals(self, normals: FloatArray) -> FloatArray:
        """Replaces normals of zero length by the area-weighted mean of the adjacent faces' normals."""
        missing = np.abs(normals).max(axis=1) == 0.0
        if not missing.any():
            return normals
        around = sum_at_vertices(area_vectors(self.positions, self.indices), self.indices, self.vertex_count)
        # Scaled, because areas of small meshes underflow in float32. Vertices without adjacent area are never visible.
        largest = np.abs(around).max(axis=1, keepdims=True)
        around = np.where(largest > 0.0, around / np.where(largest > 0.0, largest, 1.0), (0.0, 1.0, 0.0))
        return np.where(missing[:, None], around, normals).astype(np.float32)


TRIANGLE_HEIGHT_MIN = 1e-12
"""A triangle counts as without area if its height is at most this times its longest edge. Collinear corners give 1e-16
in float64, and thin triangles with float32 corners 1e-7."""

_BLOCK = 2**16
"""Number of triangles that `check_triangles` checks at once, so that their float64 corners fit the CPU cache."""


class TriangleCheck(NamedTuple):
    """Mask of a mesh's usable triangles, and counts of the unusable ones by reason."""

    usable: npt.NDArray[np.bool_]
    """True for each usable triangle, shape (F,)."""
    out_of_range: int
    """Number of triangles with an index that is negative or not below the number of vertices."""
    without_area: int
    """Number of triangles whose corners coincide or are collinear."""

    @property
    def problems(self) -> str:
        """Counts of the unusable triangles as a phrase for messages; empty if all triangles are usable."""
        return describe_problems(self.out_of_range, self.without_area)


def describe_problems(out_of_range: int, without_area: int) -> str:
    """Returns the phrase ``2 with an index that is no vertex, 7 without area``; empty if both counts are 0."""
    counts = {"with an index that is no vertex": out_of_range, "without area": without_area}
    return ", ".join(f"{count:,} {problem}" for problem, count in counts.items() if count)


def check_triangles(positions: npt.NDArray[np.float32], indices: npt.NDArray[Any]) -> TriangleCheck:
    """Finds the usable triangles of a mesh: those with an area, whose indices are all in range.

    Positions are not checked: triangles with non-finite positions count as usable.

    Args:
        positions: Vertex positions, shape (V, 3).
        indices: Triangles of any integer type, shape (F, 3).

    Raises:
        SceneError: ``indices`` are not of shape (F, 3), or not integers.
    """
    if indices.dtype.kind not in "iu":
        raise SceneError(f"indices must be integers, got {indices.dtype}")
    check_shapes(indices=(indices, "F 3"))
    in_range = np.asarray(((indices >= 0) & (indices < len(positions))).all(axis=1))
    usable = in_range.copy()
    for start in range(0, len(indices), _BLOCK):
        rows = start + np.flatnonzero(in_range[start : start + _BLOCK])
        corners = positions[indices[rows]].astype(np.float64)
        edges = corners[:, [1, 2, 0]] - corners
        doubled_areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        longest2 = np.einsum("fki,fki->fk", edges, edges).max(axis=1)
        # Non-finite positions get an error of their own; their triangles do not count as without area.
        usable[rows] = ~((doubled_areas <= TRIANGLE_HEIGHT_MIN * longest2) & np.isfinite(longest2))
    in_range_count, usable_count = int(np.count_nonzero(in_range)), int(np.count_nonzero(usable))
    return TriangleCheck(usable, len(indices) - in_range_count, in_range_count - usable_count)


def area_vectors(positions: npt.NDArray[np.floating], indices: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """Returns one vector per triangle, along its normal and with a length of twice its area, shape (F, 3)."""
    corners = positions.astype(np.float64)[indices]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def sum_at_vertices(
    vectors: npt.NDArray[np.float64], indices: npt.NDArray[np.integer], vertex_count: int
) -> npt.NDArray[np.float64]:
    """Returns for each of V vertices the sum of its triangles' ``vectors``, (F, 3), shape (V, 3)."""
    sums = np.zeros((vertex_count, 3))
    for corner in range(3):
        np.add.at(sums, indices[:, corner], vectors)
    return sums
