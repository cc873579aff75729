"""Which triangles of a mesh can be used: those whose vertices exist and that have an area."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import TRIANGLE_HEIGHT_MIN
from lumisplat.errors import SceneError, check_shapes

_BLOCK = 2**16
"""Triangles checked at once: their corners in float64 stay in the cache."""


class TriangleCheck(NamedTuple):
    """Which triangles can be used, and what is wrong with the others."""

    usable: npt.NDArray[np.bool_]
    """Shape (F,)."""
    out_of_range: int
    """Triangles with an index that is no vertex."""
    without_area: int
    """Triangles whose corners coincide or lie on a line."""

    @property
    def problems(self) -> str:
        """What is wrong, counted, in one phrase; empty where all can be used."""
        return problems(self.out_of_range, self.without_area)


def problems(out_of_range: int, without_area: int) -> str:
    """How messages say it: ``2 with an index that is no vertex, 7 without area``; empty for none of both."""
    counts = {"with an index that is no vertex": out_of_range, "without area": without_area}
    return ", ".join(f"{count:,} {problem}" for problem, count in counts.items() if count)


def check_triangles(positions: npt.NDArray[np.float32], indices: npt.NDArray) -> TriangleCheck:
    """Looks for triangles that must be left out.

    Args:
        positions: Vertices, shape (V, 3).
        indices: Triangles, shape (F, 3), of any integer type.

    Raises:
        SceneError: ``indices`` has another shape, or is not of integers.
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
        # Positions that are not finite are refused by their own name, not as triangles without area.
        usable[rows] = ~((doubled_areas <= TRIANGLE_HEIGHT_MIN * longest2) & np.isfinite(longest2))
    known, kept = int(np.count_nonzero(in_range)), int(np.count_nonzero(usable))
    return TriangleCheck(usable, len(indices) - known, known - kept)
