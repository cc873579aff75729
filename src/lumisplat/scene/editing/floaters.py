"""Gaussians that float alone: strays of training, with few others around them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import FLOATER_NEIGHBOURS, FLOATER_REACH
from lumisplat.math.arrays import Flags, FloatArray
from lumisplat.scene.checks import check_argument, check_positive, check_whole
from lumisplat.scene.editing.remaining import remaining
from lumisplat.scene.gaussians import Gaussians

FLOATER_PAIRS = 2**24
"""Candidates whose distances are in memory at once: a few hundred MB."""

_Indices = npt.NDArray[np.intp]

_STENCIL = np.array(sorted(itertools.product((-1, 0, 1), repeat=3), key=lambda offset: sum(map(abs, offset))))
"""The 27 cells around a cell, itself first, then those that share a face, an edge, a corner with it."""

_EXTENT_MAX = 2**20
"""Cells along an axis; cells farther apart may share a number, which the distances then tell apart."""


def remove_floaters(
    gaussians: Gaussians,
    neighbours: int = FLOATER_NEIGHBOURS,
    reach: float = FLOATER_REACH,
    *,
    progress: Callable[[float], None] | None = None,
) -> Gaussians:
    """Removes Gaussians that have fewer than so many others around them.

    Others count if their means are within ``reach`` times the Gaussian's largest scale, or times the capture's median
    largest scale if that is more. So wide Gaussians of a far background, which lie far apart, stay. A clump of floaters
    of more than ``neighbours`` stays, too: `crop` and `select` remove it.

    Args:
        gaussians: The capture.
        neighbours: Least number of others, 1 or more.
        reach: Distance in scales, above 0.
        progress: Called with the fraction done, 0..1.

    Returns:
        The others, in their order, unchanged.

    Raises:
        SceneError: An argument is out of range, or no Gaussian is left.
    """
    check_argument("remove_floaters", gaussians, Gaussians, "Gaussians")
    check_whole("neighbours", neighbours, 1, 1_000_000)
    check_positive("reach", reach)
    largest = gaussians.scales.max(axis=1)
    typical = np.float32(np.median(largest))
    radii = np.float32(reach) * np.maximum(largest, typical)
    # Gaussians of about the same radius are searched for together, in cells of their size.
    levels = np.ceil(np.log2(np.maximum(largest, typical) / typical)).astype(np.int64)
    floating = np.zeros(gaussians.count, dtype=bool)
    done = 0
    for level in np.unique(levels):
        rows = np.flatnonzero(levels == level)
        floating[rows] = _with_few(gaussians.means, rows, radii, neighbours)
        done += rows.size
        if progress:
            progress(done / gaussians.count)
    return remaining(gaussians, ~floating)


def _with_few(means: FloatArray, rows: _Indices, radii: FloatArray, neighbours: int) -> Flags:
    """Which of the Gaussians ``rows`` have fewer others than ``neighbours`` within their radii."""
    # The 27 cells around are near enough if two of their diagonals are the smallest radius: this settles nearly all.
    small = _Cells.of(means, float(radii[rows].min()) / np.sqrt(12.0))
    crowd = sum(small.at(rows, offset)[1] for offset in _STENCIL)
    found = np.where(crowd > neighbours, neighbours, 0)
    # The others are compared with the cells around them, one after the other, until they have found enough.
    large = _Cells.of(means, float(radii[rows].max()))
    for offset in _STENCIL:
        searching = np.flatnonzero(found < neighbours)
        starts, counts = large.at(rows[searching], offset)
        for part in _parts(counts):
            own = np.repeat(searching[part], counts[part])
            place = np.arange(own.size) + np.repeat(starts[part] - np.cumsum(counts[part]) + counts[part], counts[part])
            other = large.order[place]
            step = means[other] - means[rows[own]]
            near = np.einsum("ij,ij->i", step, step) <= radii[rows[own]] ** 2
            found += np.bincount(own[near & (other != rows[own])], minlength=rows.size)
    return found < neighbours


class _Cells(NamedTuple):
    """Means in cubic cells: cell k holds the means ``order[starts[k]:starts[k] + counts[k]]``."""

    cells: npt.NDArray[np.int64]
    """The cell of each mean, from 1, shape (N, 3)."""
    extent: npt.NDArray[np.int64]
    keys: npt.NDArray[np.int64]
    """One number for each cell that holds a mean, ascending, shape (C,)."""
    order: _Indices
    starts: _Indices
    counts: _Indices

    @staticmethod
    def of(means: FloatArray, size: float) -> _Cells:
        """Cells of side ``size``."""
        cells = np.floor(means.astype(np.float64) / size).astype(np.int64)
        cells -= cells.min(axis=0) - 1
        extent = np.minimum(cells.max(axis=0) + 2, _EXTENT_MAX)
        all_keys = _keys(cells, extent)
        order = np.argsort(all_keys, kind="stable")
        keys, starts, counts = np.unique(all_keys[order], return_index=True, return_counts=True)
        return _Cells(cells, extent, keys, order, starts, counts)

    def at(self, rows: _Indices, offset: npt.NDArray[np.int64]) -> tuple[_Indices, _Indices]:
        """Start and count of the cells at an offset from those of the Gaussians ``rows``."""
        wanted = _keys(self.cells[rows] + offset, self.extent)
        slots = np.minimum(np.searchsorted(self.keys, wanted), self.keys.size - 1)
        return self.starts[slots], np.where(self.keys[slots] == wanted, self.counts[slots], 0)


def _keys(cells: npt.NDArray[np.int64], extent: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    x, y, z = (cells % extent).T
    return (x * extent[1] + y) * extent[2] + z


def _parts(counts: _Indices) -> Iterator[_Indices]:
    """Indices of the counts, in parts that sum to about `FLOATER_PAIRS`."""
    part = np.cumsum(counts) // FLOATER_PAIRS
    yield from np.split(np.arange(counts.size), np.flatnonzero(np.diff(part)) + 1)
