"""Codebooks: 256 numbers that stand for many, with little squared error (Max 1960, Lloyd 1982)."""

from __future__ import annotations

import heapq

import numpy as np
import numpy.typing as npt

from lumisplat.io.splats.columns import Floats

ENTRIES = 256
"""Numbers of a codebook, as many as a byte has values."""

LLOYD_STEPS = 50

Doubles = npt.NDArray[np.float64]


def fit_codebook(values: Floats) -> npt.NDArray[np.float32]:
    """256 numbers in ascending order that stand for ``values``; if these are fewer different ones, the last repeats.

    The range is divided 255 times where that lowers the squared error most, so that a number far from all others gets
    an entry of its own; then entries and the borders between them are moved in turn.

    Args:
        values: Finite numbers of any shape, at least one.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = _Sums(ordered)
    borders = _divided(sums, len(ordered))
    for _ in range(LLOYD_STEPS):
        entries = sums.means(borders)
        moved = np.searchsorted(ordered, 0.5 * (entries[:-1] + entries[1:]), side="right")
        moved = np.concatenate([[0], moved, [len(ordered)]])
        if np.array_equal(moved, borders) or not (np.diff(moved) > 0).all():
            break
        borders = moved
    entries = sums.means(borders).astype(np.float32)
    return np.append(entries, np.full(ENTRIES - len(entries), entries[-1]))


def encode(values: Floats, codebook: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """The nearest entry of a codebook to each number."""
    borders = 0.5 * (codebook[:-1].astype(np.float64) + codebook[1:])
    return np.searchsorted(borders, values, side="left").astype(np.uint8)


class _Sums:
    """Sums and squared errors of runs of ascending numbers."""

    def __init__(self, ordered: Doubles) -> None:
        self._center = ordered.mean()
        around = ordered - self._center
        self._sum = np.concatenate([[0.0], np.cumsum(around)])
        self._squares = np.concatenate([[0.0], np.cumsum(around * around)])

    def means(self, borders: npt.NDArray[np.intp]) -> Doubles:
        """Means of the runs between borders."""
        return np.diff(self._sum[borders]) / np.diff(borders) + self._center

    def best_cut(self, start: int, end: int) -> tuple[float, int]:
        """By how much one cut of a run lowers its squared error at most, and where."""
        if end - start < 2:
            return 0.0, start
        cuts = np.arange(start + 1, end)
        total = self._sum[end] - self._sum[start]
        below = self._sum[cuts] - self._sum[start]
        gains = below**2 / (cuts - start) + (total - below) ** 2 / (end - cuts) - total**2 / (end - start)
        best = int(gains.argmax())
        return float(gains[best]), start + 1 + best

    def least_gain(self) -> float:
        """What is rounding, and no gain."""
        return 1e-12 * float(self._squares[-1])


def _divided(sums: _Sums, count: int) -> npt.NDArray[np.intp]:
    """Borders of at most 256 runs of so many numbers, first and last included."""

    def entry(start: int, end: int) -> tuple[float, int, int, int]:
        gain, cut = sums.best_cut(start, end)
        return -gain, start, end, cut

    runs = [entry(0, count)]
    borders = [0, count]
    while len(borders) <= ENTRIES and -runs[0][0] > sums.least_gain():
        _, start, end, cut = heapq.heappop(runs)
        borders.append(cut)
        heapq.heappush(runs, entry(start, cut))
        heapq.heappush(runs, entry(cut, end))
    return np.sort(np.array(borders, dtype=np.intp))
