"""Triangles of a mesh: which are usable (their vertices exist, their area is not zero), and their areas and normals."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError, check_shapes

TRIANGLE_HEIGHT_MIN = 1e-12
"""Height of a triangle over its longest edge, at or below which it has no area: corners on a line come out at 1e-16 in
float64, thin triangles from float32 at 1e-7."""

_BLOCK = 2**16
"""Triangles checked at once: few enough for their float64 corners to stay in the cache."""


class TriangleCheck(NamedTuple):
    """Which triangles are usable, and why the others are not."""

    usable: npt.NDArray[np.bool_]
    """Shape (F,)."""
    out_of_range: int
    """Number of triangles with an index that is no vertex."""
    without_area: int
    """Number of triangles whose corners coincide or lie on a line."""

    @property
    def problems(self) -> str:
        """The counts as a phrase for messages; empty if all triangles are usable."""
        return describe_problems(self.out_of_range, self.without_area)


def describe_problems(out_of_range: int, without_area: int) -> str:
    """The phrase of messages: ``2 with an index that is no vertex, 7 without area``; empty if both are 0."""
    counts = {"with an index that is no vertex": out_of_range, "without area": without_area}
    return ", ".join(f"{count:,} {problem}" for problem, count in counts.items() if count)


def check_triangles(positions: npt.NDArray[np.float32], indices: npt.NDArray[Any]) -> TriangleCheck:
    """Finds the triangles that a mesh cannot use.

    Args:
        positions: Vertices, shape (V, 3).
        indices: Triangles of any integer type, shape (F, 3).

    Raises:
        SceneError: ``indices`` has another shape, or another type.
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
    """Cross products of the edges, shape (F, 3): the direction is the triangle's normal, the length twice its area."""
    corners = positions.astype(np.float64)[indices]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def sum_at_vertices(
    vectors: npt.NDArray[np.float64], indices: npt.NDArray[np.integer], vertex_count: int
) -> npt.NDArray[np.float64]:
    """For each vertex, the sum of the vectors, shape (F, 3), of the triangles around it, shape (V, 3)."""
    sums = np.zeros((vertex_count, 3))
    for corner in range(3):
        np.add.at(sums, indices[:, corner], vectors)
    return sums
