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
def morton_code(point: wp.vec3, low: wp.vec3, per_cell: wp.vec3) -> int:
    """Number of a point's cell on a grid of 1024^3, along the Morton curve; points outside take the nearest cell."""
    cell = wp.cw_mul(point - low, per_cell)
    code = int(0)
    for k in range(3):
        code = code | (spread_bits(int(wp.clamp(cell[k], 0.0, 1023.0))) << k)
    return code
