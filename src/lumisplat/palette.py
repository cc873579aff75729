"""Vector quantisation by two-level k-means (Lloyd 1982): a palette of K vectors that approximate N given vectors.

K-means first divides the vectors into about sqrt(K) groups, then finds palette entries for each group separately. A
vector is compared with the entries of its group only: 2 sqrt(K) comparisons instead of K. Groups with a larger error
get more entries, which more than compensates for the coarser search; see docs/adr/0065-sog-codebooks-by-k-means.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat import palette_kernels
from lumisplat.palette_kernels import LANES, GroupedVectors, Lanes, find_nearest
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

LLOYD_STEPS = 10
"""Iterations of k-means on each level."""

BANDS_A_THREAD = 8
"""Number of ranges of vectors per CPU thread, for load balance: the cost of a vector varies with its group's entries.
"""

_FAR = 1e15
"""Components of unused palette entries, so that no vector is nearest to them; its squared distances stay finite."""

Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Palette:
    """Palette of K entries with D components, and the index of the entry that approximates each of N vectors."""

    entries: Floats
    """K palette entries with D components, shape (K, D)."""
    labels: Indices
    """Index of the entry that approximates each of N vectors, shape (N,)."""


def fit_palette(values: Floats, count: int, device: str = "auto") -> Palette:
    """Finds a palette that approximates vectors with a small squared error; repeated calls on a device agree exactly.

    Args:
        values: N finite vectors with D components, shape (N, D), at least one vector.
        count: Largest number of entries, at least 1. If there are at most ``count`` distinct vectors, they are the
            palette.
        device: Device that compares vectors with entries.

    Raises:
        DeviceError: The device does not exist.
    """
    values = np.ascontiguousarray(values, dtype=np.float32)
    rows = values.view(np.dtype((np.void, values.itemsize * values.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    if len(first) <= count:  # e.g. captures that were quantised before
        return Palette(values[first], inverse.astype(np.int64))
    launcher = Launcher(device)
    launcher.load([palette_kernels])
    groups = min(round(count**0.5), len(values))
    coarse, errors = _lloyd(launcher, values, np.zeros(len(values), dtype=np.int64), np.array([groups]))
    fine, _ = _lloyd(launcher, values, coarse.labels, group_shares(coarse.labels, errors, count))
    return fine


def group_shares(group: Indices, errors: Floats, count: int) -> Indices:
    """Divides ``count`` palette entries among groups of vectors, in proportion to sqrt(group size x squared error).

    If entries were divided by group size alone, many entries would approximate vectors that are nearly equal. Each
    group gets at least one entry, and no more entries than it has vectors.

    Args:
        group: Group of each of N vectors, shape (N,).
        errors: Squared distance of each vector to its group's mean, shape (N,).
        count: Number of entries to divide.
    """
    sizes = np.bincount(group)
    demand = np.sqrt(sizes * np.bincount(group, errors.astype(np.float64)))
    if not demand.any():
        return np.minimum(sizes, 1)
    shares = np.floor(count * demand / demand.sum()).astype(np.int64)
    return np.clip(shares, np.minimum(sizes, 1), sizes)


def _lloyd(launcher: Launcher, values: Floats, group: Indices, shares: Indices) -> tuple[Palette, Floats]:
    """Runs k-means within each group of vectors; returns the palette, and each vector's squared distance to its entry.

    Args:
        launcher: Launches the comparisons.
        values: N vectors with D components, shape (N, D).
        group: Group of each vector, shape (N,).
        shares: Number of entries of each group.
    """
    entries = _Entries(values, group, shares)
    search = _Search(launcher, values, group, entries.first_row)
    for _ in range(LLOYD_STEPS):
        labels, distances = search.nearest(entries.values)
        entries.move(labels, distances)
    labels, distances = search.nearest(entries.values)
    used, labels = np.unique(labels, return_inverse=True)
    return Palette(entries.values[used], labels), distances


class _Entries:
    """Palette entries in rows of 16. Each group's entries start a new row, so the end of its last row may be unused."""

    def __init__(self, vectors: Floats, group: Indices, shares: Indices) -> None:
        self._vectors, self._group = vectors, group
        self.first_row: Indices = np.concatenate([[0], np.cumsum(-(-shares // LANES))])
        owner = self._owner = np.repeat(np.arange(len(shares)), shares)
        rank = np.arange(len(owner)) - (np.cumsum(shares) - shares)[owner]
        self._used: Indices = LANES * self.first_row[owner] + rank
        self.values = np.full((self.first_row[-1] * LANES, vectors.shape[1]), _FAR, dtype=np.float32)
        """Entries of D components each, shape (16 * number of rows, D): a row is 16 consecutive entries. Unused entries
        hold `_FAR`."""
        # Entries start at vectors spread evenly over the group: captures in Morton order make that even in space.
        members = np.argsort(group, kind="stable")
        sizes = np.bincount(group, minlength=len(shares))
        picks = (np.cumsum(sizes) - sizes)[owner] + rank * sizes[owner] // shares[owner]
        self.values[self._used] = vectors[members[picks]]

    def move(self, labels: Indices, distances: Floats) -> None:
        """Moves each entry to the mean of the vectors that chose it, and unused entries to badly fitted vectors."""
        order = np.argsort(labels, kind="stable")
        found, starts, counts = np.unique(labels[order], return_index=True, return_counts=True)
        sums = np.add.reduceat(self._vectors[order], starts, axis=0, dtype=np.float64)
        self.values[found] = sums / counts[:, None]
        idle = np.bincount(labels, minlength=len(self.values))[self._used] == 0
        for g in np.unique(self._owner[idle]):
            slots = self._used[idle & (self._owner == g)]
            inside = np.nonzero(self._group == g)[0]
            farthest = inside[np.argsort(-distances[inside], kind="stable")[: len(slots)]]
            self.values[slots] = self._vectors[farthest]


class _Search:
    """Vectors uploaded to the device, for repeated searches of the nearest palette entry."""

    def __init__(self, launcher: Launcher, values: Floats, group: Indices, first_row: Indices) -> None:
        self._launcher, self._buffers, self._count = launcher, Buffers(launcher.device), len(values)
        self._vectors = GroupedVectors()
        self._vectors.components = values.shape[1]
        self._vectors.values = self._buffers.upload("values", float, values.reshape(-1))
        self._vectors.group = self._buffers.upload("group", int, group.astype(np.int32))
        self._vectors.first_row = self._buffers.upload("first_row", int, first_row.astype(np.int32))

    def nearest(self, entries: Floats) -> tuple[Indices, Floats]:
        """Returns, for each vector, the index of the nearest entry of its group, and the squared distance to it."""
        rows = entries.reshape(-1, LANES, entries.shape[1]).transpose(0, 2, 1).reshape(-1, LANES)
        self._vectors.entries = self._buffers.upload("entries", Lanes, rows)
        entry = self._buffers.get("entry", int, self._count)
        distance = self._buffers.get("distance", float, self._count)
        bands = BANDS_A_THREAD * self._launcher.threads
        self._launcher.run_banded(find_nearest, self._count, self._vectors, entry, distance, bands=bands)
        return entry.numpy().astype(np.int64), distance.numpy().copy()
