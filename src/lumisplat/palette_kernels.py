"""Finds the nearest palette entry of each vector. One thread per vector; it reads its group's entries, 16 at a time."""

import warp as wp

from lumisplat.device.structs import struct

wp.set_module_options({"enable_backward": False})

LANES = 16
"""Number of palette entries that are compared with a vector side by side: one or two vector registers of a CPU."""

Lanes = wp.types.vector(length=LANES, dtype=wp.float32)


@struct
class GroupedVectors:
    """N vectors of D components in groups, and each group's palette entries."""

    components: int
    """Number of components, D."""
    values: wp.array[float]
    """Components of all vectors, vector by vector, length N D."""
    group: wp.array[int]
    """Index of each vector's group; a vector is compared with the palette entries of its group only."""
    entries: wp.array[Lanes]
    """Palette entries in rows of 16, D consecutive elements a row, one for each component; unused entries are farther
    away than every vector."""
    first_row: wp.array[int]
    """Index of the first row of palette entries of each group, and finally the total number of rows."""


@wp.kernel(enable_backward=False)
def find_nearest(start: int, vectors: GroupedVectors, entry_out: wp.array[int], distance_out: wp.array[float]):
    """Writes the nearest entry of each vector's group, as 16 row + position in the row, and its squared distance."""
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
