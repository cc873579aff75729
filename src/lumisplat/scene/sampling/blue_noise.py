"""Blue noise: Poisson-disk elimination of points, with a neighbour search over a hash grid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SAMPLING_RADIUS_STEP, SAMPLING_RADIUS_STEPS_MAX
from lumisplat.math.arrays import FloatArray

_Indices = npt.NDArray[np.integer]

_CELL_BITS = 21
_CELL_MASK = (1 << _CELL_BITS) - 1
_CELL_MAX = 2.0**40
"""Number of a cell, at most: points farther out are in the last one, all of them."""


class Pairs(NamedTuple):
    """Neighbours closer than some radius: entry k pairs point ``first[k]`` with point ``second[k]``."""

    first: _Indices
    second: _Indices
    distance: FloatArray

    def where(self, rows: npt.NDArray[np.bool_]) -> Pairs:
        """The pairs that a mask selects."""
        return Pairs(self.first[rows], self.second[rows], self.distance[rows])


class _Grid(NamedTuple):
    """Points in cubic cells: cell k holds the points ``order[starts[k]:starts[k] + counts[k]]``."""

    points: FloatArray
    """The points in cell order, shape (M, 3)."""
    order: _Indices
    cells: npt.NDArray[np.int64]
    """Occupied cells, shape (C, 3)."""
    keys: npt.NDArray[np.int64]
    """One number per cell, ascending, shape (C,)."""
    starts: _Indices
    counts: _Indices


def cell_order(points: npt.NDArray[np.floating], size: float) -> _Indices:
    """The order that sorts points into cubic cells of side ``size``: neighbours in space get close in memory."""
    return np.argsort(_cell_keys(_cells(points, size)), kind="stable")


def neighbour_pairs(points: npt.NDArray[np.floating], radius: float) -> Pairs:
    """All pairs of points closer than ``radius``, each once.

    Points are sorted into cubic cells of side ``radius``; each cell is compared with itself and half of its 26
    neighbours.

    Args:
        points: Shape (M, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    grid = _grid(points, radius)
    return _join_pairs([_pairs_at(grid, grid, offset, radius) for offset in _STENCIL[13:]], grid, grid)


def cross_pairs(points: npt.NDArray[np.floating], others: npt.NDArray[np.floating], radius: float) -> Pairs:
    """All pairs of a point (``first``) and one of ``others`` (``second``) closer than ``radius``.

    Args:
        points: Shape (M, 3).
        others: Shape (C, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    grid, other = _grid(points, radius), _grid(others, radius)
    return _join_pairs([_pairs_at(grid, other, offset, radius) for offset in _STENCIL], grid, other)


def poisson_disk(pairs: Pairs, priority: _Indices, count: int, radius: float) -> _Indices:
    """Indices of ``count`` of M points that are as far from each other as elimination gets them.

    Points are visited by priority, in parallel: a point is kept if no undecided or kept point with a higher priority is
    within the radius. When no more points fit, the radius shrinks a little and the others are tried again (dart
    throwing in the order of McCool and Fiume 1992, in parallel by Luby's independent-set rule). Every point left out is
    closer to a kept one than the final radius, up to one shrinking step.

    Args:
        pairs: All neighbours closer than ``radius``.
        priority: A permutation of 0..M-1, shape (M,); the smallest number comes first.
        count: Number of points to keep, 1..M.
        radius: First radius; a radius above the distance of the densest packing only takes longer.

    Returns:
        Sorted indices, shape (count,).
    """
    swapped = priority[pairs.first] > priority[pairs.second]
    pairs = pairs._replace(
        first=np.where(swapped, pairs.second, pairs.first), second=np.where(swapped, pairs.first, pairs.second)
    )
    kept = np.zeros(priority.size, dtype=bool)
    for _ in range(SAMPLING_RADIUS_STEPS_MAX):
        before = kept.copy()
        pairs = pairs.where(pairs.distance < radius)
        _keep_maximal(pairs, kept)
        if np.count_nonzero(kept) >= count:
            return _fill_up(before, kept & ~before, priority, count)
        radius *= SAMPLING_RADIUS_STEP
    # Coincident points are never far enough apart: they fill up the number.
    return _fill_up(kept, ~kept, priority, count)


def _fill_up(kept: npt.NDArray[np.bool_], more: npt.NDArray[np.bool_], priority: _Indices, count: int) -> _Indices:
    """The kept points and the first of ``more`` by priority, ``count`` in total, sorted."""
    rows = np.flatnonzero(more)
    rows = rows[np.argsort(priority[rows])][: count - np.count_nonzero(kept)]
    return np.sort(np.concatenate([np.flatnonzero(kept), rows]))


def _keep_maximal(pairs: Pairs, kept: npt.NDArray[np.bool_]) -> None:
    """Adds points to ``kept`` until every point is kept or paired with a kept one."""
    first, second, _ = pairs
    undecided = ~kept
    undecided[second[kept[first]]] = False
    undecided[first[kept[second]]] = False
    while undecided.any():
        rows = undecided[first] & undecided[second]
        first, second = first[rows], second[rows]
        winners = undecided.copy()
        winners[second] = False
        kept |= winners
        undecided &= ~winners
        undecided[second[winners[first]]] = False


def _cells(points: npt.NDArray[np.floating], size: float) -> npt.NDArray[np.int64]:
    with np.errstate(over="ignore"):
        cells = np.floor(np.asarray(points, dtype=np.float32) / np.float32(size))
    return np.clip(cells, -_CELL_MAX, _CELL_MAX).astype(np.int64)


def _cell_keys(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    # Cells very far apart may share a key: the distance test removes their pairs.
    x, y, z = (cells & _CELL_MASK).T
    return (x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z


def _grid(points: npt.NDArray[np.floating], size: float) -> _Grid:
    order = cell_order(points, size)
    points = np.asarray(points, dtype=np.float32)[order]
    cells = _cells(points, size)
    keys, starts, counts = np.unique(_cell_keys(cells), return_index=True, return_counts=True)
    return _Grid(points, order.astype(np.int32), cells[starts], keys, starts, counts)


def _pairs_at(grid: _Grid, other: _Grid, offset: _Indices, radius: float) -> Pairs:
    """Close pairs, in cell order, of each cell of ``other`` with the cell of ``grid`` that lies at ``offset``."""
    wanted = _cell_keys(other.cells + offset)
    slots = np.minimum(np.searchsorted(grid.keys, wanted), grid.keys.size - 1)
    occupied = np.flatnonzero(grid.keys[slots] == wanted)
    slots = slots[occupied]
    first, second = _products(grid.starts[slots], grid.counts[slots], other.starts[occupied], other.counts[occupied])
    if grid is other and not offset.any():
        once = first < second
        first, second = first[once], second[once]
    step = grid.points[first] - other.points[second]
    distance2 = np.einsum("ij,ij->i", step, step)
    near = distance2 < radius * radius
    return Pairs(first[near], second[near], np.sqrt(distance2[near]))


def _join_pairs(found: list[Pairs], grid: _Grid, other: _Grid) -> Pairs:
    """All pairs, as indices of the points in their original order."""
    first, second, distance = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Pairs(grid.order[first], other.order[second], distance)


def _products(a_start: _Indices, a_count: _Indices, b_start: _Indices, b_count: _Indices) -> tuple[_Indices, _Indices]:
    """All combinations of a row from range a and a row from range b, for all k pairs of ranges at once."""
    sizes = a_count * b_count
    local = np.arange(int(sizes.sum()), dtype=np.int32)
    local -= np.repeat((np.cumsum(sizes) - sizes).astype(np.int32), sizes)
    row = local // np.repeat(b_count.astype(np.int32), sizes)
    column = local - row * np.repeat(b_count.astype(np.int32), sizes)
    return row + np.repeat(a_start.astype(np.int32), sizes), column + np.repeat(b_start.astype(np.int32), sizes)


_STENCIL = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
