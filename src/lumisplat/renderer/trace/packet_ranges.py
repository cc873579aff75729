"""Rays that are followed once more, some at a time, in the company in which they were followed first."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lumisplat.constants import PACKET_RAYS
from lumisplat.math.arrays import IntArray, Rows


def packet_ranges(counts: IntArray, most: int) -> Iterator[tuple[int, int, int]]:
    """Ranges of rays, and how many hits each has: no more than ``most`` unless it is the least range.

    Rays that were followed together are again: ranges are of whole packets of CPUs and of whole warps.

    Args:
        counts: Hits of each ray.
        most: How many hits a range is to have at most.
    """
    edges = np.append(np.arange(0, len(counts), 2 * PACKET_RAYS), len(counts))
    before: Rows = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])[edges]
    begin, parts = 0, len(edges) - 1
    while begin < parts:
        end = max(int(np.searchsorted(before, int(before[begin]) + most, side="right")) - 1, begin + 1)
        found = int(before[end] - before[begin])
        if found:
            yield int(edges[begin]), int(edges[end]), found
        begin = end
