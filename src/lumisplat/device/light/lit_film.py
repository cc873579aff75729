"""From samples of a lit ray to the pixel's running means (docs/method/lighting.md#captured-and-added-light)."""

import warp as wp

from lumisplat.device.math.color import captured_color
from lumisplat.device.mesh.first_surface import store_sample
from lumisplat.device.structs.rays import RaySurface
from lumisplat.device.structs.scene import PixelData, struct

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
    surface: PixelData,
    lit: LitPixels,
    nonfinite: wp.array(dtype=int),
    kept: wp.vec3,
    kept_inout: wp.array(dtype=wp.vec3),
):
    """Sample n moves the means by 1 / (n + 1) of the way; light that is not finite is left out, and counted.

    After the ``last`` one, the colour is made of both, and what shadows take from the captured goes to the light. That
    is a share of its mean, ``kept`` as a mean of its own in an array that may be empty: means of display colours and of
    linear ones do not subtract.
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
    darkens = kept_inout.shape[0] > 0
    if darkens:
        if sample == 0:
            kept_inout[pixel] = kept
        else:
            kept_inout[pixel] += (kept - kept_inout[pixel]) / float(sample + 1)
    if last:
        own = captured_color(surface.color[pixel], lit.captured_weight[pixel])
        if darkens:
            lit.light[pixel] += wp.cw_mul(own, kept_inout[pixel] - wp.vec3(1.0))
        color = own + lit.light[pixel]
        lit.color[pixel] = wp.max(color, wp.vec3(0.0))
