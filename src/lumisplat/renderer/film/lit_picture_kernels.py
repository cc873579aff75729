"""Pictures of lit frames, encoded on the device. One item is one pixel."""

import warp as wp

from lumisplat.device.film.tone_map import channels_finite, lit_color, packed_rgba, straightened
from lumisplat.device.structs.camera import LitPixels, PictureData, PixelData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def encode_lit_pixels(
    start: int, picture: PictureData, pixels: PixelData, lit: LitPixels, picture_out: wp.array[wp.uint32]
):
    """As ``encode_pixels``, of a lit frame, which is exposed and tone-mapped."""
    i = start + wp.tid()
    captured = pixels.color[i]
    alpha = pixels.alpha[i]
    weight = lit.captured_weight[i]
    light = lit.light[i]
    finite = channels_finite(captured) and channels_finite(light) and channels_finite(lit.color[i])
    if not (finite and wp.isfinite(alpha) and wp.isfinite(weight)):
        picture_out[picture_out.shape[0] - 1] = wp.uint32(1)  # the same from every thread
        return
    if picture.straight != 0:
        captured = straightened(captured, alpha)
        light = straightened(light, alpha)
        weight = straightened(wp.vec3(weight), alpha)[0]
    picture_out[i] = packed_rgba(lit_color(captured, weight, light, picture), alpha)
