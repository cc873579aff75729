"""Pictures of unlit frames, encoded on the device. One item is one pixel."""

import warp as wp

from lumisplat.device.structs.film import PixelData

# Products and sums are rounded one by one, as the host's are: so are the bytes.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.func
def byte_of(value: float) -> wp.uint32:
    """A display-referred value as 8 bits, clamped to 0..1 and rounded half up."""
    return wp.uint32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5)


@wp.kernel
def encode_pixels(straight: bool, pixels: PixelData, picture_out: wp.array[wp.uint32]):
    """Red, green, blue and alpha of each pixel in one word, and in the last word how many pixels are not finite.

    Colours are divided by alpha if they are to be ``straight``. Not to be banded: atomic.
    """
    i = wp.tid()
    color = pixels.color[i]
    alpha = pixels.alpha[i]
    finite = wp.isfinite(color[0]) and wp.isfinite(color[1]) and wp.isfinite(color[2]) and wp.isfinite(alpha)
    if not finite:
        wp.atomic_add(picture_out, picture_out.shape[0] - 1, wp.uint32(1))
        return
    if straight:
        share = alpha
        if not alpha > 0.0:
            color = wp.vec3(0.0)
            share = 1.0
        color = wp.vec3(color[0] / share, color[1] / share, color[2] / share)
    word = byte_of(color[0]) | (byte_of(color[1]) << wp.uint32(8)) | (byte_of(color[2]) << wp.uint32(16))
    picture_out[i] = word | (byte_of(alpha) << wp.uint32(24))
