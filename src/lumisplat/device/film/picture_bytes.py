"""Display colours as the bytes of a picture."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def channels_finite(color: wp.vec3) -> bool:
    """Whether no channel is NaN or infinite; their sum may be."""
    return wp.isfinite(color[0]) and wp.isfinite(color[1]) and wp.isfinite(color[2])


@wp.func
def straightened(color: wp.vec3, alpha: float) -> wp.vec3:
    """A premultiplied colour divided by its alpha; black where that is not above 0."""
    if not alpha > 0.0:
        return wp.vec3(0.0)
    return wp.vec3(color[0] / alpha, color[1] / alpha, color[2] / alpha)


@wp.func
def byte_of(value: float) -> wp.uint32:
    """A display-referred value as 8 bits, clamped to 0..1 and rounded half up."""
    return wp.uint32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5)


@wp.func
def packed_rgba(color: wp.vec3, alpha: float) -> wp.uint32:
    """A pixel in one word, red in the low byte."""
    word = byte_of(color[0]) | (byte_of(color[1]) << wp.uint32(8)) | (byte_of(color[2]) << wp.uint32(16))
    return word | (byte_of(alpha) << wp.uint32(24))
