"""Means over frames of what depends on the means of other frames (docs/method/realtime.md#bounces)."""

import warp as wp

from lumisplat.constants.realtime import YOUNG_SHARE

wp.set_module_options({"enable_backward": False})

SHARE = wp.constant(wp.float32(YOUNG_SHARE))


@wp.func
def mean_weight(count: float, history: float) -> float:
    """For how many samples a mean of ``count`` counts when one more is added; less than all of them while it is young.

    Args:
        count: Samples so far.
        history: Samples that a mean goes back.
    """
    if count < history:
        return SHARE * count
    return history - 1.0
