"""Kernels that sum over warps, for their tests; two kinds of sums must not share memory."""

import warp as wp

from lumisplat.device.math.memory import warp_sums

BLOCKS = wp.get_module(f"{__name__}.blocks")
wp.set_module_options({"enable_backward": False, "block_dim": 128}, BLOCKS)

WARPS, ROWS = 4, 64
Short = wp.types.vector(length=5, dtype=wp.float32)
Long = wp.types.vector(length=16, dtype=wp.float32)
add_short, sum_of_short = warp_sums(Short, WARPS, ROWS)
add_long, sum_of_long = warp_sums(Long, WARPS, ROWS)


@wp.kernel(module=BLOCKS, grid_stride=False)
def probe_sums(
    shorts: wp.array3d[Short],
    longs: wp.array3d[Long],
    has_part: wp.array3d[bool],
    shorts_out: wp.array2d[Short],
    longs_out: wp.array2d[Long],
):
    """Sums values over the threads that have one, for each row of each thread block."""
    block, thread = wp.tid()
    for row in range(ROWS):
        add_short(row, shorts[block, row, thread], has_part[block, row, thread])
        add_long(row, longs[block, row, thread], has_part[block, row, thread])
    threads = wp.tile_sum(wp.tile(1))[0]  # waits
    if thread < ROWS and threads > 0:
        shorts_out[block, thread] = sum_of_short(thread)
        longs_out[block, thread] = sum_of_long(thread)
