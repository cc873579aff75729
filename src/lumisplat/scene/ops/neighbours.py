"""Point sets: Morton order, neighbour pairs, and blue-noise thinning."""

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
    """Sorts a capture along a Morton curve (Morton 1966); the capture's file then compresses better.

    Args:
        gaussians: Capture.

    Returns:
        The same Gaussians in another order. Frames are the same, except where Gaussians have exactly equal depth.
    """
    check_argument("sort_morton", gaussians, Gaussians, "Gaussians")
    return gaussians.subset(morton_order(gaussians.means))


def morton_order(positions: _Floats) -> npt.NDArray[np.int64]:
    """Returns indices that sort N points, shape (N, 3), along a Morton curve with 2^21 cells per axis.

    A thousandth of the points at each end of each axis is clamped; otherwise one outlier could put all other points
    into one cell.
    """
    low, high = np.quantile(positions.astype(np.float64), (0.001, 0.999), axis=0)
    extent = np.maximum(high - low, np.finfo(np.float32).tiny)
    shares = [np.clip((positions[:, axis] - low[axis]) / extent[axis], 0.0, 1.0) for axis in range(3)]
    return np.argsort(morton_codes(np.stack(shares)), kind="stable")


def morton_codes(shares: _Floats) -> npt.NDArray[np.uint64]:
    """Returns the Morton codes, shape (N,), of N points in the unit cube, given as x, y and z rows, shape (3, N)."""
    code = np.zeros(shares.shape[1], dtype=np.uint64)
    for axis in range(3):
        bits = (shares[axis] * (2**21 - 1)).astype(np.uint64)
        # Spreads 21 bits to every third position; each step halves the groups of bits that move together.
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
"""Factor by which the radius of Poisson-disk elimination shrinks, repeatedly, while too few points are selected."""

SAMPLING_RADIUS_STEPS_MAX = 100
"""Largest number of times that the Poisson-disk radius shrinks, to a twentieth in all. Points closer together than the
last radius are then selected by priority until the wanted number is reached."""

_Indices = npt.NDArray[np.integer]

_CELL_BITS = 21
_CELL_MASK = (1 << _CELL_BITS) - 1
_CELL_MAX = 2.0**40
"""Largest magnitude of a cell coordinate in `cell_order`; points farther from zero share the outermost cell."""

_MARGIN = 1.0 + 1e-6
"""Factor on the radius of SciPy's float64 neighbour search; its results are then filtered by float32 distances."""


_ROUNDS = 4
"""Number of further radii that `pairs_of_about` tries if the first one gives too many or too few neighbours."""


class Pairs(NamedTuple):
    """Pairs of points closer than a radius: entry k pairs point ``first[k]`` with point ``second[k]``."""

    first: _Indices
    second: _Indices
    distance: FloatArray

    def where(self, rows: npt.NDArray[np.bool_]) -> Pairs:
        """Returns the pairs that the mask ``rows`` selects."""
        return Pairs(self.first[rows], self.second[rows], self.distance[rows])


def cell_order(points: npt.NDArray[np.floating], size: float) -> _Indices:
    """Returns indices that sort points by cubic cells of side ``size``, so that neighbours are close in memory."""
    with np.errstate(over="ignore"):
        cells = np.floor(np.asarray(points, dtype=np.float32) / np.float32(size))
    x, y, z = (np.clip(cells, -_CELL_MAX, _CELL_MAX).astype(np.int64) & _CELL_MASK).T
    return np.argsort((x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z, kind="stable")


def neighbour_pairs(points: npt.NDArray[np.floating], radius: float) -> Pairs:
    """Returns all pairs of points closer than ``radius``, each pair once.

    Args:
        points: M points, shape (M, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    points = np.asarray(points, np.float32)
    found = cKDTree(points).query_pairs(radius * _MARGIN, output_type="ndarray")
    return _closer(points, points, found[:, 0], found[:, 1], radius)


def cross_pairs(points: npt.NDArray[np.floating], others: npt.NDArray[np.floating], radius: float) -> Pairs:
    """Returns the pairs of one of ``points`` (``first``) and one of ``others`` (``second``) closer than ``radius``.

    Args:
        points: M points, shape (M, 3).
        others: C points, shape (C, 3).
        radius: Search distance, > 0, in the points' unit.
    """
    points, others = np.asarray(points, np.float32), np.asarray(others, np.float32)
    found = cKDTree(points).sparse_distance_matrix(cKDTree(others), radius * _MARGIN, output_type="ndarray")
    return _closer(points, others, found["i"], found["j"], radius)


def _closer(points: FloatArray, others: FloatArray, first: _Indices, second: _Indices, radius: float) -> Pairs:
    """Returns, sorted, the pairs of ``points[first]`` and ``others[second]`` closer than the radius in float32."""
    order = np.lexsort((second, first))
    first, second = first[order], second[order]
    step = points[first] - others[second]
    distance2 = np.einsum("ij,ij->i", step, step)
    near = distance2 < radius * radius
    return Pairs(first[near], second[near], np.sqrt(distance2[near]))


def poisson_disk(pairs: Pairs, priority: _Indices, count: int, radius: float) -> _Indices:
    """Selects ``count`` of M points by Poisson-disk elimination; returns their indices.

    Points are visited by priority, in parallel: a point is selected if no undecided or selected point with a higher
    priority is within the radius. When no more points fit, the radius shrinks a little and the remaining points are
    tried again (dart throwing in the order of McCool and Fiume 1992, in parallel by Luby's independent-set rule). In
    the end, the distance from every unselected point to the nearest selected one is below the final radius, up to one
    shrinking step.

    Args:
        pairs: All neighbours closer than ``radius``.
        priority: A permutation of 0..M-1, shape (M,); the smallest number comes first.
        count: Number of points to select, 1..M.
        radius: First radius; a radius above the distance of the densest packing only takes longer.

    Returns:
        Sorted indices, shape (count,).
    """
    swapped = priority[pairs.first] > priority[pairs.second]
    pairs = pairs._replace(
        first=np.where(swapped, pairs.second, pairs.first), second=np.where(swapped, pairs.first, pairs.second)
    )
    selected = np.zeros(priority.size, dtype=bool)
    for _ in range(SAMPLING_RADIUS_STEPS_MAX):
        before = selected.copy()
        pairs = pairs.where(pairs.distance < radius)
        _select_maximal(pairs, selected)
        if np.count_nonzero(selected) >= count:
            return _fill_up(before, selected & ~before, priority, count)
        radius *= SAMPLING_RADIUS_STEP
    # Coincident points are never far enough apart, so they fill up the number.
    return _fill_up(selected, ~selected, priority, count)


def _fill_up(selected: npt.NDArray[np.bool_], more: npt.NDArray[np.bool_], priority: _Indices, count: int) -> _Indices:
    """Returns ``count`` sorted indices: all points of ``selected``, and those of ``more`` with the highest priority."""
    rows = np.flatnonzero(more)
    rows = rows[np.argsort(priority[rows])][: count - np.count_nonzero(selected)]
    return np.sort(np.concatenate([np.flatnonzero(selected), rows]))


def _select_maximal(pairs: Pairs, selected: npt.NDArray[np.bool_]) -> None:
    """Selects further points, in place, until every point is selected or paired with a selected one.

    Args:
        pairs: Pairs of points that are too close to be both selected; the first has the higher priority.
        selected: True for selected points; changed in place, shape (M,).
    """
    first, second, _ = pairs
    undecided = ~selected
    undecided[second[selected[first]]] = False
    undecided[first[selected[second]]] = False
    while undecided.any():
        rows = undecided[first] & undecided[second]
        first, second = first[rows], second[rows]
        winners = undecided.copy()
        winners[second] = False
        selected |= winners
        undecided &= ~winners
        undecided[second[winners[first]]] = False


def pairs_of_about(
    count: int, points: npt.NDArray[np.floating], pairs_within: Callable[[float], Pairs]
) -> tuple[Pairs, float]:
    """Returns the pairs within a radius at which the median point has about ``count`` neighbours, and the radius.

    On a surface the number of neighbours grows with the square of the radius; this rule corrects the first guess.

    Args:
        count: Wanted number of neighbours of a point.
        points: N points, shape (N, 3).
        pairs_within: Returns the pairs closer than a radius, each pair in both orders.

    Returns:
        The pairs, and the radius in the points' unit.
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
