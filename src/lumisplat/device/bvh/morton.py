"""Numbers of cells along the Morton curve, on which neighbours lie near each other."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def spread_bits(x: int) -> int:
    """Two zero bits after each of the ten bits of ``x``."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249


@wp.func
def code_of_cell(cell: wp.vec3i) -> int:
    """Number of a cell of a grid of 1024^3."""
    return spread_bits(cell[0]) | (spread_bits(cell[1]) << 1) | (spread_bits(cell[2]) << 2)


@wp.func
def morton_code(point: wp.vec3, low: wp.vec3, per_cell: wp.vec3) -> int:
    """Number of a point's cell on a grid of 1024^3; points outside take the nearest cell."""
    cell = wp.cw_mul(point - low, per_cell)
    x = int(wp.clamp(cell[0], 0.0, 1023.0))
    y = int(wp.clamp(cell[1], 0.0, 1023.0))
    return code_of_cell(wp.vec3i(x, y, int(wp.clamp(cell[2], 0.0, 1023.0))))
