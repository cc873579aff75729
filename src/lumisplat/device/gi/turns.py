"""Which pixels have samples of light in a frame (``RealtimeConfig.light_interval``)."""

import warp as wp

from lumisplat.constants import RAY_BLOCK_PX

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(RAY_BLOCK_PX)


@wp.func
def has_turn(x: int, y: int, interval: int, frame: int) -> bool:
    """Whether a pixel has samples in this frame: all have in the first one, then every ``interval``-th block."""
    return frame == 0 or (x // BLOCK + y // BLOCK + frame) % interval == 0
