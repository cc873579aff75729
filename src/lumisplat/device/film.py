"""From samples of a lit ray to the pixel's running means."""

import warp as wp

from lumisplat.device.color import captured_color
from lumisplat.device.ray_structs import RaySurface
from lumisplat.device.ray_surface import store_sample
from lumisplat.device.structs import SurfaceData, struct

wp.set_module_options({"enable_backward": False})


@struct
class LitPixels:
    """What a lit frame keeps beside the surface buffers, whose colour is what was captured; one element a pixel."""

    captured_weight: wp.array(dtype=float)
    """Share of the pixel that was captured."""
    light: wp.array(dtype=wp.vec3)
    """Linear: what light adds or shadows take."""
    color: wp.array(dtype=wp.vec3)
    """Linear: both together, once the last sample is there."""


@wp.func
def store_lit_sample(
    pixel: int,
    sample: int,
    captured: wp.vec3,
    captured_weight: float,
    light: wp.vec3,
    alpha: float,
    last: bool,
    found: RaySurface,
    surface: SurfaceData,
    lit: LitPixels,
    nonfinite: wp.array(dtype=int),
):
    """Sample n moves the means by 1 / (n + 1) of the way; light that is not finite is left out, and counted.

    After the ``last`` one, the colour is made of both.
    """
    if not wp.isfinite(light[0] + light[1] + light[2]):
        light = wp.vec3(0.0)
        nonfinite[pixel] = nonfinite[pixel] + 1
    store_sample(pixel, sample, captured, alpha, found, surface, nonfinite)
    if sample == 0:
        lit.captured_weight[pixel] = captured_weight
        lit.light[pixel] = light
    else:
        share = 1.0 / float(sample + 1)
        lit.captured_weight[pixel] += share * (captured_weight - lit.captured_weight[pixel])
        lit.light[pixel] += share * (light - lit.light[pixel])
    if last:
        color = captured_color(surface.color[pixel], lit.captured_weight[pixel]) + lit.light[pixel]
        lit.color[pixel] = wp.max(color, wp.vec3(0.0))
