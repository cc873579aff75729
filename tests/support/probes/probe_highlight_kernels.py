"""Kernel that evaluates the microfacets of a pixel for their test."""

import warp as wp

from lumisplat.device.light.lobe_lights import facets_in_pixel

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_facets(alpha: float, footprint: float, halves: wp.array[wp.vec3], values_out: wp.array[float]):
    """Evaluates D of a surface with the normal z for half vectors."""
    i = wp.tid()
    values_out[i] = facets_in_pixel(wp.vec3(0.0, 0.0, 1.0), halves[i], alpha, footprint)
