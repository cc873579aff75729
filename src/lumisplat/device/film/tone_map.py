"""Tone mapping on the device, equal to `lumisplat.math.tone_map` on the host, and conversion of pixels to bytes.

The equations are in docs/method/lighting.md#developed-frames.
"""

import warp as wp

from lumisplat.constants import (
    AGX_GAMMA,
    AGX_PIVOT,
    AGX_SHOULDER,
    AGX_SLOPE,
    AGX_STOPS,
    AGX_TOE,
    NEUTRAL_DESATURATION,
    NEUTRAL_START,
    NEUTRAL_TOE,
    RADIANCE_MAX,
    WEIGHT_ROUNDING,
)
from lumisplat.device.math.color import captured_color, encode_srgb_color, is_black
from lumisplat.device.structs.camera import TONE_AGX, TONE_NEUTRAL, ToneMapData

BRIGHTEST = wp.constant(wp.float32(RADIANCE_MAX))

WHOLE = wp.constant(wp.float32(1.0 - WEIGHT_ROUNDING))

TOE = wp.constant(wp.float32(NEUTRAL_TOE))

START = wp.constant(wp.float32(NEUTRAL_START))

DESATURATION = wp.constant(wp.float32(NEUTRAL_DESATURATION))

STOPS_LOW = wp.constant(wp.float32(AGX_STOPS[0]))

STOPS_RANGE = wp.constant(wp.float32(AGX_STOPS[1] - AGX_STOPS[0]))

DARKEST = wp.constant(wp.float32(2.0 ** AGX_STOPS[0]))

PIVOT_X = wp.constant(wp.float32(AGX_PIVOT[0]))

PIVOT_Y = wp.constant(wp.float32(AGX_PIVOT[1]))

SLOPE = wp.constant(wp.float32(AGX_SLOPE))

POWER_BELOW = wp.constant(wp.float32(AGX_TOE))

POWER_ABOVE = wp.constant(wp.float32(AGX_SHOULDER))

GAMMA = wp.constant(wp.float32(AGX_GAMMA))


def curve_scale(run: float, rise: float, power: float) -> float:
    """Returns the scale of one side of AgX's sigmoid: the distance from the pivot to the asymptote of that side.

    ``run`` and ``rise`` are the distances from the pivot to the side's end point, through which the curve passes;
    ``power`` is the exponent of the side.
    """
    return AGX_SLOPE * run / ((AGX_SLOPE * run / rise) ** power - 1.0) ** (1.0 / power)


SCALE_BELOW = wp.constant(wp.float32(curve_scale(AGX_PIVOT[0], AGX_PIVOT[1], AGX_TOE)))

SCALE_ABOVE = wp.constant(wp.float32(curve_scale(1.0 - AGX_PIVOT[0], 1.0 - AGX_PIVOT[1], AGX_SHOULDER)))


@wp.func
def clamped(color: wp.vec3, high: float) -> wp.vec3:
    """Clamps all channels of a colour to 0..high."""
    return wp.vec3(wp.clamp(color[0], 0.0, high), wp.clamp(color[1], 0.0, high), wp.clamp(color[2], 0.0, high))


@wp.func
def neutral(light: wp.vec3) -> wp.vec3:
    """Applies the Khronos PBR Neutral tone map, linear to linear."""
    least = wp.min(wp.min(light), 2.0 * TOE)
    color = light - wp.vec3(least - least * least / (4.0 * TOE))
    peak = wp.max(color)
    if peak < START:
        return color
    room = 1.0 - START
    compressed = 1.0 - room * room / (peak + room - START)
    saturation = 1.0 / (DESATURATION * (peak - compressed) + 1.0)
    white = wp.vec3(compressed)
    return white + saturation * (color * (compressed / peak) - white)


@wp.func
def agx_curve(light: float) -> float:
    """Applies AgX's sigmoid to the base-2 logarithm of a linear channel; returns 0..1, display-encoded."""
    stops = wp.log2(wp.max(light, DARKEST))
    x = wp.clamp((stops - STOPS_LOW) / STOPS_RANGE, 0.0, 1.0)
    scale = wp.where(x < PIVOT_X, SCALE_BELOW, SCALE_ABOVE)
    power = wp.where(x < PIVOT_X, POWER_BELOW, POWER_ABOVE)
    distance = (SLOPE / scale) * (x - PIVOT_X)
    return PIVOT_Y + scale * distance / wp.pow(1.0 + wp.pow(wp.abs(distance), power), 1.0 / power)


@wp.func
def agx(light: wp.vec3, settings: ToneMapData) -> wp.vec3:
    """Applies the AgX tone map, linear to linear."""
    inset = settings.agx_from_rec709 * light
    shown = settings.rec2020_from_agx * wp.vec3(agx_curve(inset[0]), agx_curve(inset[1]), agx_curve(inset[2]))
    for k in range(3):
        shown[k] = wp.pow(wp.max(shown[k], 0.0), GAMMA)
    return settings.rec709_from_rec2020 * shown


@wp.func
def tone_mapped(light: wp.vec3, settings: ToneMapData) -> wp.vec3:
    """Tone maps linear light, at least 0, and encodes it as display-referred sRGB, 0..1."""
    color = light
    if settings.tone_map == TONE_NEUTRAL:
        color = neutral(light)
    elif settings.tone_map == TONE_AGX:
        color = agx(light, settings)
    return encode_srgb_color(clamped(color, 1.0))


@wp.func
def lit_color(captured: wp.vec3, weight: float, light: wp.vec3, settings: ToneMapData) -> wp.vec3:
    """Returns the display-referred colour of a pixel that shows captured colour, linear light, or both.

    Light is tone mapped; captured colour without light keeps its look, scaled by the gain. On the host, ``lit_picture``
    computes the same.
    """
    if settings.gain == 1.0 and weight >= WHOLE and is_black(light):
        return captured
    radiance = captured_color(captured, weight)
    lit = clamped(settings.gain * (radiance + light), BRIGHTEST)
    before = clamped(settings.gain * radiance, BRIGHTEST)
    largest = wp.max(wp.max(lit), wp.max(before))
    if largest == 0.0:
        return wp.vec3(0.0)
    captured_part = 1.0 - wp.max(wp.abs(lit - before)) / largest
    before_color = encode_srgb_color(before)
    shown = tone_mapped(lit, settings)
    if captured_part > 0.0:  # else all is light, and the curve is evaluated once
        shown += captured_part * (before_color - tone_mapped(before, settings))
    for k in range(3):
        if lit[k] >= before[k]:
            shown[k] = wp.max(shown[k], before_color[k])
        else:
            shown[k] = wp.min(shown[k], before_color[k])
    return shown


# --- Bytes ---


@wp.func
def channels_finite(color: wp.vec3) -> bool:
    """Returns whether no channel is NaN or infinite; each channel is tested, because a sum could overflow."""
    return wp.isfinite(color[0]) and wp.isfinite(color[1]) and wp.isfinite(color[2])


@wp.func
def straightened(color: wp.vec3, alpha: float) -> wp.vec3:
    """Divides a premultiplied colour by its alpha; black where alpha is not above 0."""
    if not alpha > 0.0:
        return wp.vec3(0.0)
    return wp.vec3(color[0] / alpha, color[1] / alpha, color[2] / alpha)


@wp.func
def byte_of(value: float) -> wp.uint32:
    """Converts a display-referred value to 8 bits, clamped to 0..1 and rounded half up."""
    return wp.uint32(wp.clamp(value, 0.0, 1.0) * 255.0 + 0.5)


@wp.func
def packed_rgba(color: wp.vec3, alpha: float) -> wp.uint32:
    """Packs a display-referred pixel into a 32-bit word of four bytes: red in the low byte, alpha in the high one."""
    word = byte_of(color[0]) | (byte_of(color[1]) << wp.uint32(8)) | (byte_of(color[2]) << wp.uint32(16))
    return word | (byte_of(alpha) << wp.uint32(24))
