"""Kernel that computes the sort keys of incoherent rays. One thread per ray."""

import warp as wp

from lumisplat.device.math.sorting import code_of_cell
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def key_rays(start: int, per_cell: float, last: int, rays: RayData, keys_out: wp.array[int], order_out: wp.array[int]):
    """Writes a ray's sort key: Morton code of its origin's cell, then octant of its direction; ``last`` if inactive.

    The grid of 16^3 cells repeats in all directions, so it needs no bounds.
    """
    i = start + wp.tid()
    order_out[i] = i
    keys_out[i] = last
    if rays.is_active[i]:
        scaled = per_cell * rays.origin[i]
        direction = rays.direction[i]
        octant = int(direction[0] > 0.0) + 2 * int(direction[1] > 0.0) + 4 * int(direction[2] > 0.0)
        cells = wp.vec3i(int(wp.floor(scaled[0])), int(wp.floor(scaled[1])), int(wp.floor(scaled[2])))
        keys_out[i] = 8 * code_of_cell(wp.vec3i(cells[0] & 15, cells[1] & 15, cells[2] & 15)) + octant
