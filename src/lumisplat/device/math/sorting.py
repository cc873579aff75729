"""Sorting helpers: Morton codes of grid cells, and binary search."""

from typing import Any

import warp as wp


@wp.func
def spread_bits(x: int) -> int:
    """Inserts two zero bits after each of the ten bits of ``x``."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249


@wp.func
def code_of_cell(cell: wp.vec3i) -> int:
    """Returns the Morton code of a cell of a 1024^3 grid."""
    return spread_bits(cell[0]) | (spread_bits(cell[1]) << 1) | (spread_bits(cell[2]) << 2)


@wp.func
def morton_code(point: wp.vec3, low: wp.vec3, per_cell: wp.vec3) -> int:
    """Returns the Morton code of the cell of a 1024^3 grid around a point; for a point outside, of the nearest cell.

    ``low`` is the grid's lower corner, and ``per_cell`` the number of cells per unit of length.
    """
    cell = wp.cw_mul(point - low, per_cell)
    x = int(wp.clamp(cell[0], 0.0, 1023.0))
    y = int(wp.clamp(cell[1], 0.0, 1023.0))
    return code_of_cell(wp.vec3i(x, y, int(wp.clamp(cell[2], 0.0, 1023.0))))


@wp.func
def first_not_below(values: wp.array[Any], count: int, limit: Any) -> int:
    """Returns the index of the first of ``count`` ascending values that is >= ``limit``; ``count`` if there is none.

    Warp's ``lower_bound`` would never return ``count``.
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
