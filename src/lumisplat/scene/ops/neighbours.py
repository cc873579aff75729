"""Orders points so that neighbours are close in memory, pairs neighbours, and thins points to blue noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from lumisplat.math.arrays import FloatArray
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians

_Floats = npt.NDArray[np.floating]


def sort_morton(gaussians: Gaussians) -> Gaussians:
    """Sorts a capture along a Morton curve (Morton 1966), by which formats compress better.

    Args:
        gaussians: The capture.

    Returns:
        The same Gaussians in another order. Pictures are the same, but for Gaussians of exactly equal depth.
    """
    check_argument("sort_morton", gaussians, Gaussians, "Gaussians")
    return gaussians.subset(morton_order(gaussians.means))


def morton_order(positions: _Floats) -> npt.NDArray[np.int64]:
    """Indices that sort points, shape (N, 3), along a Morton curve of 2^21 cells per axis.

    The curve leaves out a thousandth of the points at each end, so that one stray cannot put all others into one cell.
    """
    low, high = np.quantile(positions.astype(np.float64), (0.001, 0.999), axis=0)
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    shares = [np.clip((positions[:, axis] - low[axis]) / extent[axis], 0.0, 1.0) for axis in range(3)]
    return np.argsort(morton_codes(np.stack(shares)), kind="stable")


def morton_codes(shares: _Floats) -> npt.NDArray[np.uint64]:
    """Places along the curve, shape (N,), of points in the unit cube, shape (3, N)."""
    code = np.zeros(shares.shape[1], dtype=np.uint64)
    for axis in range(3):
        bits = (shares[axis] * (2**21 - 1)).astype(np.uint64)
        # Moves 21 bits to every third place; each step halves the groups of bits that move together.
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


SAMPLING_RADIUS_STEP = 0.97
"""Factor by which the radius shrinks while too few points are kept."""

SAMPLING_RADIUS_STEPS_MAX = 100
"""Steps at most, to a twentieth of the radius: closer points coincide, and make up for those missing."""

_Indices = npt.NDArray[np.integer]

_CELL_BITS = 21
_CELL_MASK = (1 << _CELL_BITS) - 1
_CELL_MAX = 2.0**40
"""Number of a cell, at most: points farther out are in the last one, all of them."""

_MARGIN = 1.0 + 1e-6
"""Factor of the radius that SciPy searches, in float64: what it finds is compared with the radius in float32."""


_ROUNDS = 4
"""Radii that are tried after the first one."""


class Pairs(NamedTuple):
    """Neighbours closer than some radius: entry k pairs point ``first[k]`` with point ``second[k]``."""

    first: _Indices
    second: _Indices
    distance: FloatArray

    def where(self, rows: npt.NDArray[np.bool_]) -> Pairs:
        """The pairs that a mask selects."""
        return Pairs(self.first[rows], self.second[rows], self.distance[rows])


def cell_order(points: npt.NDArray[np.floating], size: float) -> _Indices:
    """Returns the order that sorts points into cubic cells of side ``size``, so that neighbours are close in memory."""
    with np.errstate(over="ignore"):
        cells = np.floor(np.asarray(points, dtype=np.float32) / np.float32(size))
    x, y, z = (np.clip(cells, -_CELL_MAX, _CELL_MAX).astype(np.int64) & _CELL_MASK).T
    return np.argsort((x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z, kind="stable")


def neighbour_pairs(points: npt.NDArray[np.floating], radius: float) -> Pairs:
    """Returns all pairs of points closer than ``radius``, each once.

    Args:
        points: Shape (M, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    points = np.asarray(points, np.float32)
    found = cKDTree(points).query_pairs(radius * _MARGIN, output_type="ndarray")
    return _closer(points, points, found[:, 0], found[:, 1], radius)


def cross_pairs(points: npt.NDArray[np.floating], others: npt.NDArray[np.floating], radius: float) -> Pairs:
    """Returns all pairs of a point (``first``) and one of ``others`` (``second``) closer than ``radius``.

    Args:
        points: Shape (M, 3).
        others: Shape (C, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    points, others = np.asarray(points, np.float32), np.asarray(others, np.float32)
    found = cKDTree(points).sparse_distance_matrix(cKDTree(others), radius * _MARGIN, output_type="ndarray")
    return _closer(points, others, found["i"], found["j"], radius)


def _closer(points: FloatArray, others: FloatArray, first: _Indices, second: _Indices, radius: float) -> Pairs:
    """Returns the pairs whose distance in float32 is below the radius, in the order of their indices."""
    order = np.lexsort((second, first))
    first, second = first[order], second[order]
    step = points[first] - others[second]
    distance2 = np.einsum("ij,ij->i", step, step)
    near = distance2 < radius * radius
    return Pairs(first[near], second[near], np.sqrt(distance2[near]))


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


def pairs_of_about(
    count: int, points: npt.NDArray[np.floating], pairs_within: Callable[[float], Pairs]
) -> tuple[Pairs, float]:
    """Pairs of points within a radius, chosen so that the median point has about ``count`` others, and the radius.

    On a surface the number grows with the square of the radius: it is guessed, and then corrected by what is found.

    Args:
        count: Of a point's pairs.
        points: Shape (N, 3).
        pairs_within: Pairs closer than a radius, each in both orders.
    """
    low, high = np.quantile(points, [0.25, 0.75], axis=0)
    radius = max(float(np.linalg.norm(high - low)) * np.sqrt(count / len(points)), 1e-9)
    pairs = pairs_within(radius)
    for _ in range(_ROUNDS):
        typical = max(float(np.median(np.bincount(pairs.first, minlength=len(points)))), 1.0)
        if 0.7 < typical / count < 1.6:
            break
        radius *= float(np.clip(np.sqrt(count / typical), 0.25, 3.0))
        pairs = pairs_within(radius)
    return pairs, radius
