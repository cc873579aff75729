"""Tiles of the image whose pixels are shared out among the warps of a CUDA block, a square of them each."""

import warp as wp

from lumisplat.constants import TILE_PX

wp.set_module_options({"enable_backward": False})

WARP_THREADS = 32
"""Threads that add up without a barrier. Of all NVIDIA GPUs."""
TILE_WARPS = 4
"""Warps of a tile."""
TILE_THREADS = WARP_THREADS * TILE_WARPS

THREADS = wp.constant(TILE_THREADS)
_LANES = wp.constant(WARP_THREADS)
_SIDE = wp.constant(TILE_PX // 2)
"""Pixels along the square of a warp."""
ROWS = wp.constant(TILE_PX * TILE_PX // TILE_THREADS)
"""Pixels of a thread: one in each fourth row of the square."""
STRIDE = wp.constant(WARP_THREADS // (TILE_PX // 2))
"""Rows from one of them to the next."""
RowFloats = wp.types.vector(length=TILE_PX * TILE_PX // TILE_THREADS, dtype=wp.float32)
"""A number of each of them."""


@wp.func
def first_pixel(thread: int) -> wp.vec2i:
    """The uppermost pixel of a thread of a tile, from the tile's corner."""
    warp = thread // _LANES
    lane = thread % _LANES
    return wp.vec2i((warp % 2) * _SIDE + lane % _SIDE, (warp // 2) * _SIDE + lane // _SIDE)
