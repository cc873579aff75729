"""Pictures of unlit frames, encoded on the device. One item is one pixel."""

import warp as wp

from lumisplat.device.film.tone_map import channels_finite, packed_rgba, straightened
from lumisplat.device.structs.camera import PixelData

# Products and sums are rounded one by one, as the host's are: so are the bytes.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def encode_pixels(start: int, straight: bool, pixels: PixelData, picture_out: wp.array[wp.uint32]):
    """Red, green, blue and alpha of each pixel in one word, and in the last word 1 if some pixel is not finite.

    Colours are divided by alpha if they are to be ``straight``.
    """
    i = start + wp.tid()
    color = pixels.color[i]
    alpha = pixels.alpha[i]
    if not (channels_finite(color) and wp.isfinite(alpha)):
        picture_out[picture_out.shape[0] - 1] = wp.uint32(1)  # the same from every thread
        return
    if straight:
        color = straightened(color, alpha)
    picture_out[i] = packed_rgba(color, alpha)
