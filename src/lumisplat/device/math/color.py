"""Colour on the device: the sRGB transfer function, luminance, and captured colours."""

import warp as wp

from lumisplat.constants import LUMINANCE

LUMINANCE_WEIGHTS = wp.constant(wp.vec3(*LUMINANCE))


@wp.func
def luminance(color: wp.vec3) -> float:
    """Returns the luminance of a linear colour."""
    return wp.dot(LUMINANCE_WEIGHTS, color)


@wp.func
def encode_srgb(linear: float) -> float:
    """Encodes a linear value >= 0 as a display-referred one (IEC 61966-2-1)."""
    if linear <= 0.0031308:
        return 12.92 * linear
    return 1.055 * wp.pow(linear, 1.0 / 2.4) - 0.055


@wp.func
def encode_srgb_color(linear: wp.vec3) -> wp.vec3:
    """Encodes a linear colour as display-referred sRGB."""
    return wp.vec3(encode_srgb(linear[0]), encode_srgb(linear[1]), encode_srgb(linear[2]))


@wp.func
def decode_srgb(display: float) -> float:
    """Decodes a display-referred value >= 0 to a linear one (IEC 61966-2-1), to 1e-6 relative.

    Up to 1, x^2.4 = u^4 u^0.8 with u = sqrt(x), and a minimax polynomial replaces u^0.8: faster than a power.
    """
    if display <= 0.04045:
        return display * 0.07739938
    x = display * 0.9478673 + 0.052132703
    if x > 1.0:
        return wp.pow(x, 2.4)
    u = wp.sqrt(x)
    p = 1.11872172 - u * 0.19020686
    p = 2.92086467 + u * (-4.29111446 + u * (4.37879682 + u * (-2.90127493 + u * p)))
    p = 0.02520098 + u * (1.47191918 + u * (-1.53290736 + u * p))
    return x * x * p


@wp.func
def decode_srgb_color(display: wp.vec3) -> wp.vec3:
    """Decodes a display-referred sRGB colour to a linear one."""
    return wp.vec3(decode_srgb(display[0]), decode_srgb(display[1]), decode_srgb(display[2]))


@wp.func
def mean_of(color: wp.vec3) -> float:
    """Returns the mean of the three channels."""
    return (color[0] + color[1] + color[2]) / 3.0


@wp.func
def is_black(color: wp.vec3) -> bool:
    """Returns whether all channels are 0."""
    return color[0] == 0.0 and color[1] == 0.0 and color[2] == 0.0


@wp.func
def captured_color(captured: wp.vec3, weight: float) -> wp.vec3:
    """Converts a display-referred captured colour to a linear one; both are premultiplied by alpha ``weight``."""
    if weight <= 0.0:
        return wp.vec3(0.0)
    return weight * decode_srgb_color(captured / weight)


@wp.func
def over(color: wp.vec3, transmittance: float, behind: wp.vec3) -> wp.vec3:
    """Returns ``color + transmittance * behind``: a premultiplied colour composited over the colour behind it.

    The sum uses double precision, in which the product is exact, so that the result does not depend on whether a
    compiler fuses multiplication and addition.
    """
    result = wp.vec3()
    for k in range(3):
        result[k] = float(wp.float64(color[k]) + wp.float64(transmittance) * wp.float64(behind[k]))
    return result
