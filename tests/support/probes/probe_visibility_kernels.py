"""Kernels that call functions of light visibility, for tests."""

import warp as wp

from lumisplat.device.gi.light_visibility import pack, sample_variance, unpack

wp.set_module_options({"enable_backward": False})


@wp.kernel
def repack(values: wp.array[wp.vec3], values_out: wp.array[wp.vec3]):
    """Packs and unpacks visibilities."""
    i = wp.tid()
    values_out[i] = unpack(pack(values[i]))


@wp.kernel
def find_variances(values: wp.array[float], counts: wp.array[float], variances_out: wp.array[float]):
    """Finds the variance of samples of visibilities."""
    i = wp.tid()
    variances_out[i] = sample_variance(values[i], counts[i])
