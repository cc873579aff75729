"""Tiles of the image whose pixels are shared out among the threads of a CUDA warp."""

import warp as wp

from lumisplat.constants import TILE_PX

wp.set_module_options({"enable_backward": False})

WARP_THREADS = 32
"""Threads that add up without a barrier. Of all NVIDIA GPUs."""

LANES = wp.constant(WARP_THREADS)
ROWS = wp.constant(TILE_PX * TILE_PX // WARP_THREADS)
"""Pixels of a thread: one in each second row of the tile."""
STRIDE = wp.constant(WARP_THREADS // TILE_PX)
"""Rows from one of them to the next."""
RowFloats = wp.types.vector(length=TILE_PX * TILE_PX // WARP_THREADS, dtype=wp.float32)
"""A number of each of them."""
