"""Kernels that evaluate SH on the device, for their tests."""

import warp as wp

from lumisplat.device.math.sh import sh_color

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_sh_colors(
    sh: wp.array(dtype=wp.vec3), degree: int, directions: wp.array(dtype=wp.vec3), colors_out: wp.array(dtype=wp.vec3)
):
    """Evaluates one set of SH coefficients in many directions."""
    i = wp.tid()
    colors_out[i] = sh_color(sh, 0, degree, directions[i])
