"""Parallel primitives of Warp's library, with types: prefix sums, sorts and copies of device arrays."""

# Warp leaves the elements of their arrays without annotations.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import warp as wp

from lumisplat.runtime.buffers import DeviceArray


def prefix_sum(values: DeviceArray, sums: DeviceArray, *, inclusive: bool) -> None:
    """Writes the sums of ``values`` up to each element, ``inclusive`` of it or not."""
    wp.utils.array_scan(values, sums, inclusive=inclusive)


def sort_pairs(keys: DeviceArray, values: DeviceArray, count: int, *, bits: int | None = None) -> None:
    """Sorts the first ``count`` keys ascending, and their values with them; the sort is stable.

    Args:
        keys: Twice as many elements as are sorted; the second half is scratch space.
        values: As many as keys.
        count: Elements to sort.
        bits: Low bits of the keys that count; None: all.
    """
    wp.utils.radix_sort_pairs(keys, values, count, end_bit=bits)


def copy_elements(source: DeviceArray, target: DeviceArray, count: int) -> None:
    """Copies the first ``count`` elements."""
    wp.copy(target, source, count=count)
