"""A kernel that evaluates the weights of running means over frames, for their test."""

import warp as wp

from lumisplat.device.gi.surfaces import mean_weight

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_weights(counts: wp.array[float], histories: wp.array[float], weights_out: wp.array[float]):
    """Evaluates the weight of running means from their sample counts and history lengths."""
    i = wp.tid()
    weights_out[i] = mean_weight(counts[i], histories[i])
