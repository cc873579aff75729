"""The nearest entry of a palette to each vector. One item is one vector; it reads its group's entries, 16 at a time."""

import warp as wp

from lumisplat.device.structs import struct

wp.set_module_options({"enable_backward": False})

LANES = 16
"""Entries that are compared side by side: a vector register or two on CPUs."""

Lanes = wp.types.vector(length=LANES, dtype=wp.float32)


@struct
class GroupedVectors:
    """N vectors of D components in groups, each with entries of its own."""

    components: int
    """D."""
    values: wp.array[float]
    """Components, vector by vector."""
    group: wp.array[int]
    """Group of each vector."""
    entries: wp.array[Lanes]
    """Rows of 16 entries, component by component; unused ones are far away from everything."""
    first_row: wp.array[int]
    """First row of each group, and at the end the number of rows."""


@wp.kernel(enable_backward=False)
def find_nearest(start: int, vectors: GroupedVectors, entry_out: wp.array[int], distance_out: wp.array[float]):
    """Writes the nearest entry of the vector's group, 16 row + lane, the first of equals, and its squared distance."""
    i = start + wp.tid()
    nearest = int(-1)
    least = float(wp.inf)
    for row in range(vectors.first_row[vectors.group[i]], vectors.first_row[vectors.group[i] + 1]):
        distances = Lanes()
        for k in range(vectors.components):
            value = Lanes(vectors.values[i * vectors.components + k])
            difference = value - vectors.entries[row * vectors.components + k]
            distances += wp.cw_mul(difference, difference)
        for lane in range(LANES):
            if distances[lane] < least:
                least = distances[lane]
                nearest = LANES * row + lane
    entry_out[i] = nearest
    distance_out[i] = least
