"""Pictures of unlit frames, encoded on the device. One item is one pixel."""

import warp as wp

from lumisplat.device.film.picture_bytes import channels_finite, packed_rgba, straightened
from lumisplat.device.structs.film import PixelData

# Products and sums are rounded one by one, as the host's are: so are the bytes.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def encode_pixels(straight: bool, pixels: PixelData, picture_out: wp.array[wp.uint32]):
    """Red, green, blue and alpha of each pixel in one word, and in the last word how many pixels are not finite.

    Colours are divided by alpha if they are to be ``straight``. Not to be banded: atomic.
    """
    i = wp.tid()
    color = pixels.color[i]
    alpha = pixels.alpha[i]
    if not (channels_finite(color) and wp.isfinite(alpha)):
        wp.atomic_add(picture_out, picture_out.shape[0] - 1, wp.uint32(1))
        return
    if straight:
        color = straightened(color, alpha)
    picture_out[i] = packed_rgba(color, alpha)
