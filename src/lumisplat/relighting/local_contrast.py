"""How bright the surroundings of a Gaussian are (docs/method/relighting.md#light-estimation)."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LIGHT_SEARCH_PRIOR

_RING = [offset for offset in itertools.product(range(-2, 3), repeat=3) if max(map(abs, offset)) == 2]
"""Offsets of the cells around the 3 x 3 x 3 that hold a candidate's own emitter."""

_CELL_BITS = 21


def surroundings(
    means: npt.NDArray[np.floating], scores: npt.NDArray[np.floating], rows: npt.NDArray[np.integer], size: float
) -> npt.NDArray[np.float64]:
    """Root mean square score around some Gaussians, in the direction where it is highest.

    Space is cut into cubic cells of side ``size``. A Gaussian's own cell and its neighbours hold its emitter, if that
    is no larger than ``size``; the ring of cells around these is its surroundings, divided into octants. The brightest
    octant counts: even the corner of a bright wall has more of the wall in one of them. Squares let a wall count as
    bright despite dark pictures on it.

    Args:
        means: Shape (N, 3).
        scores: Shape (N,).
        rows: The Gaussians whose surroundings are returned, shape (R,).
        size: Scene units, > 0.

    Returns:
        Shape (R,), above 0 if any score is.
    """
    cells = np.floor((means - means.min(axis=0)) / size).astype(np.int64) + 2
    keys, inverse = np.unique(_keys(cells), return_inverse=True)
    counts = np.bincount(inverse, minlength=keys.size).astype(np.float64)
    squares = np.asarray(scores, dtype=np.float64) ** 2
    sums = np.bincount(inverse, weights=squares, minlength=keys.size)
    _, firsts, back = np.unique(inverse[rows], return_index=True, return_inverse=True)
    centers = cells[rows[firsts]]
    # Each octant starts with some Gaussians of median score, so that a single neighbour does not decide it.
    octant_counts = np.full((8, len(centers)), LIGHT_SEARCH_PRIOR)
    octant_sums = octant_counts * np.median(squares)
    for offset in _RING:
        neighbours = _keys(centers + np.array(offset))
        slots = np.minimum(np.searchsorted(keys, neighbours), keys.size - 1)
        occupied = keys[slots] == neighbours
        for octant, signs in enumerate(itertools.product((-1, 1), repeat=3)):
            if all(step * sign >= 0 for step, sign in zip(offset, signs, strict=True)):
                octant_counts[octant] += np.where(occupied, counts[slots], 0.0)
                octant_sums[octant] += np.where(occupied, sums[slots], 0.0)
    return np.sqrt((octant_sums / octant_counts).max(axis=0))[back]


def _keys(cells: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    x, y, z = cells.T
    return (x << 2 * _CELL_BITS) | (y << _CELL_BITS) | z
