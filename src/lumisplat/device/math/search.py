"""Search in sorted arrays."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def first_not_below(values: wp.array[Any], count: int, limit: Any) -> int:
    """Index of the first of ``count`` ascending values that is at least ``limit``; ``count`` if none is.

    The library's ``lower_bound`` never returns its end.
    """
    low = int(0)
    high = int(count)
    while low < high:
        middle = low + (high - low) // 2
        if values[middle] < limit:
            low = middle + 1
        else:
            high = middle
    return low
