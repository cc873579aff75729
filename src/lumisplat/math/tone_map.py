"""Development of lit frames into images: exposure, tone mapping, and captured colours that keep their tones.

The equations are in docs/method/lighting.md#developed-frames.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import ToneMap
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
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb, encode_srgb

_Light = npt.NDArray[np.floating]

# AgX. Blender insets the Rec.2020 primaries before the curve and outsets them after it
# (github.com/EaryChow/AgX_LUT_Gen).
_REC2020_FROM_REC709 = np.array([[0.6274, 0.3293, 0.0433], [0.0691, 0.9195, 0.0113], [0.0164, 0.0880, 0.8956]])
REC709_FROM_REC2020 = np.linalg.inv(_REC2020_FROM_REC709).astype(np.float32)
_INSET = [
    [0.856627153315983, 0.0951212405381588, 0.0482516061458583],
    [0.137318972929847, 0.761241990602591, 0.101439036467562],
    [0.11189821299995, 0.0767994186031903, 0.811302368396859],
]
AGX_FROM_REC709 = (np.array(_INSET) @ _REC2020_FROM_REC709).astype(np.float32)
_OUTSET = [
    [0.899796955911611, 0.0871996192028351, 0.013003424885555],
    [0.11142098895748, 0.875575586156966, 0.0130034248855548],
    [0.11142098895748, 0.0871996192028349, 0.801379391839686],
]
REC2020_FROM_AGX = np.linalg.inv(_OUTSET).astype(np.float32)


def captured_radiance(captured: npt.ArrayLike, weight: npt.ArrayLike) -> FloatArray:
    """Converts captured colours to linear Rec.709 radiance: un-premultiplied, decoded and premultiplied again.

    Args:
        captured: Display-referred sRGB premultiplied by ``weight``, shape (..., 3).
        weight: Fraction of the pixel that the capture covers, 0..1, shape (...).

    Returns:
        Shape (..., 3); zero where ``weight`` is zero.
    """
    captured, share = np.asarray(captured, np.float32), np.asarray(weight, np.float32)[..., None]
    straight = np.divide(captured, share, out=np.zeros_like(captured), where=share > 0.0)
    return (decode_srgb(straight) * share).astype(np.float32)


def apply_tone_map(linear: npt.ArrayLike, tone_map: ToneMap) -> FloatArray:
    """Maps linear light to display colours.

    ``AGX`` is the variant of Blender and Filament, in Rec.2020 primaries. It evaluates Sobotka's curve in closed form;
    Filament and three.js use a polynomial fit, which differs by at most 0.006. Blender's mixing of hues is left out.

    Args:
        linear: Linear Rec.709 after exposure, shape (..., 3). Negative values count as 0, infinite ones as the
            brightest; NaN stays NaN.
        tone_map: Tone curve.

    Returns:
        sRGB, 0..1, shape (..., 3).
    """
    light = np.clip(np.asarray(linear, np.float32), 0.0, RADIANCE_MAX)
    if tone_map is ToneMap.NEUTRAL:
        light = _neutral(light)
    elif tone_map is ToneMap.AGX:
        light = _agx(light)
    return np.clip(encode_srgb(np.clip(light, 0.0, 1.0)), 0.0, 1.0).astype(np.float32)


def exposure_gain(exposure: float) -> float:
    """Returns the factor by which an exposure in stops scales linear light."""
    return float(np.exp2(np.float32(exposure).clip(-64, 64)))


def lit_picture(
    captured: npt.ArrayLike, weight: npt.ArrayLike, light: npt.ArrayLike, exposure: float, tone_map: ToneMap
) -> FloatArray:
    """Returns the display colours of pixels that show captures, lit surfaces, or both.

    Captured light is encoded by the sRGB curve of its capture, other light by the tone mapper. A mixed pixel of
    radiance x with captured part e has the colour ``tone(x) + k (srgb(e) - tone(e))``, where ``k = 1 - |x - e| / max(x,
    e)`` and both magnitudes are maxima over the channels. Where light is added, no channel becomes darker than the
    capture; where light is removed, none becomes brighter.

    Args:
        captured: Display-referred sRGB premultiplied by ``weight``, shape (..., 3).
        weight: Fraction of the pixel that the capture covers, 0..1, shape (...).
        light: Linear Rec.709 added to the capture, or removed where negative, shape (..., 3).
        exposure: Exposure of the sum in stops.
        tone_map: Tone curve of light that was not captured.

    Returns:
        sRGB, shape (..., 3), 0..1. Pixels that show only a capture, at exposure 0, equal ``captured`` to the bit.
    """
    captured, weight, light = (np.asarray(values, np.float32) for values in (captured, weight, light))
    result = np.array(captured)
    is_covered = weight >= 1.0 - WEIGHT_ROUNDING
    changed = ~is_covered | (light != 0.0).any(axis=-1) if exposure == 0.0 else np.ones_like(is_covered)
    radiance, gain = captured_radiance(captured[changed], weight[changed]), np.float32(exposure_gain(exposure))
    with np.errstate(over="ignore"):  # overflow becomes infinity, which is clipped
        lit, before = (np.clip(gain * part, 0.0, RADIANCE_MAX) for part in (radiance + light[changed], radiance))
    largest = np.maximum(lit, before).max(axis=-1, keepdims=True)
    difference = np.abs(lit - before).max(axis=-1, keepdims=True)
    captured_part = 1.0 - np.divide(difference, largest, out=np.zeros_like(largest), where=largest > 0.0)
    unchanged = encode_srgb(before)
    shown = apply_tone_map(lit, tone_map) + captured_part * (unchanged - apply_tone_map(before, tone_map))
    shown = np.where(lit >= before, np.maximum(shown, unchanged), np.minimum(shown, unchanged))
    result[changed] = np.clip(shown, 0.0, 1.0)
    return result


def _neutral(light: _Light) -> _Light:
    """Applies Khronos PBR Neutral, linear to linear: subtracts the Fresnel reflection, compresses above 0.76."""
    least = np.minimum(light.min(axis=-1, keepdims=True), 2.0 * NEUTRAL_TOE)
    color = light - (least - least**2 / (4.0 * NEUTRAL_TOE))
    peak = color.max(axis=-1, keepdims=True)
    headroom = 1.0 - NEUTRAL_START
    bright = np.maximum(peak, NEUTRAL_START)
    compressed = 1.0 - headroom**2 / (bright + headroom - NEUTRAL_START)
    saturation = 1.0 / (NEUTRAL_DESATURATION * (bright - compressed) + 1.0)
    highlight: _Light = compressed + saturation * (color * (compressed / bright) - compressed)
    result: _Light = np.where(peak < NEUTRAL_START, color, highlight)
    return result


def _agx(light: _Light) -> _Light:
    """Applies AgX, linear to linear. Colours outside the display's gamut come out below 0 or above 1."""
    low, high = AGX_STOPS
    stops = np.log2(np.maximum(light @ AGX_FROM_REC709.T, np.float32(2.0**low)))
    curved = _agx_curve(np.clip((stops - low) / (high - low), 0.0, 1.0))
    return np.maximum(curved @ REC2020_FROM_AGX.T, 0.0) ** AGX_GAMMA @ REC709_FROM_REC2020.T


def _agx_curve(x: _Light) -> _Light:
    """Evaluates Jed Smith's sigmoid: straight at the pivot, bent by a power on each side to pass (0, 0) and (1, 1)."""
    pivot_x, pivot_y = AGX_PIVOT
    curved = x.copy()  # NaN is on neither side of the pivot
    for side, run, rise, power in (
        (x < pivot_x, pivot_x, pivot_y, AGX_TOE),
        (x >= pivot_x, 1.0 - pivot_x, 1.0 - pivot_y, AGX_SHOULDER),
    ):
        # Distance of the asymptote from the pivot for which the curve passes its end point.
        scale = AGX_SLOPE * run / ((AGX_SLOPE * run / rise) ** power - 1.0) ** (1.0 / power)
        distance = (AGX_SLOPE / scale) * (x[side] - pivot_x)
        curved[side] = pivot_y + scale * distance / (1.0 + np.abs(distance) ** power) ** (1.0 / power)
    return curved


_WHITE = 1.0 - 1e-6
"""Display value to which larger ones are clipped before a tone map is inverted; at 1 the curves have no inverse."""


def remove_tone_map(display: npt.ArrayLike, tone_map: ToneMap) -> Doubles:
    """Inverts `lumisplat.math.tone_map.apply_tone_map`: returns the linear light of display colours.

    Args:
        display: sRGB, 0..1, shape (..., 3). Values clipped at 0 or 1 return the end of the range.
        tone_map: Tone curve that was applied.

    Returns:
        Linear Rec.709 after exposure, non-negative, shape (..., 3), float64.
    """
    light = decode_srgb(np.clip(np.asarray(display, np.float64), 0.0, 1.0))
    if tone_map is ToneMap.NEUTRAL:
        light = _without_neutral(light)
    elif tone_map is ToneMap.AGX:
        light = _without_agx(light)
    return np.maximum(light, 0.0)


def _without_neutral(shown: npt.NDArray[np.floating]) -> Doubles:
    """Inverts `_neutral`: returns the linear light of linear display values."""
    peak = np.minimum(shown.max(axis=-1, keepdims=True), _WHITE)
    headroom = 1.0 - NEUTRAL_START
    bright = np.maximum(peak, NEUTRAL_START)
    before = headroom**2 / (1.0 - bright) - headroom + NEUTRAL_START
    saturation = 1.0 / (NEUTRAL_DESATURATION * (before - bright) + 1.0)
    color = (bright + (shown - bright) / saturation) * (before / bright)
    color = np.where(peak < NEUTRAL_START, shown, color)
    least = np.maximum(color.min(axis=-1, keepdims=True), 0.0)
    taken = np.where(least <= NEUTRAL_TOE, np.sqrt(4.0 * NEUTRAL_TOE * least) - least, NEUTRAL_TOE)
    return np.asarray(color + taken, np.float64)


def _without_agx(shown: npt.NDArray[np.floating]) -> Doubles:
    """Inverts `_agx`: returns the linear light of linear display values."""
    low, high = AGX_STOPS
    rec2020 = np.maximum(shown @ np.linalg.inv(REC709_FROM_REC2020.astype(np.float64)).T, 0.0)
    curved = rec2020 ** (1.0 / AGX_GAMMA) @ np.linalg.inv(REC2020_FROM_AGX.astype(np.float64)).T
    stops = low + (high - low) * _before_agx_curve(curved)
    return np.asarray(2.0**stops @ np.linalg.inv(AGX_FROM_REC709.astype(np.float64)).T, np.float64)


def _before_agx_curve(curved: npt.NDArray[np.floating]) -> Doubles:
    """Inverts the sigmoid of `_agx_curve`; the result lies in 0..1."""
    pivot_x, pivot_y = AGX_PIVOT
    x = np.zeros(curved.shape)
    for side, run, rise, power in (
        (curved < pivot_y, pivot_x, pivot_y, AGX_TOE),
        (curved >= pivot_y, 1.0 - pivot_x, 1.0 - pivot_y, AGX_SHOULDER),
    ):
        scale = AGX_SLOPE * run / ((AGX_SLOPE * run / rise) ** power - 1.0) ** (1.0 / power)
        share = np.clip((curved[side] - pivot_y) / scale, -_WHITE, _WHITE)
        distance = share / (1.0 - np.abs(share) ** power) ** (1.0 / power)
        x[side] = pivot_x + scale / AGX_SLOPE * distance
    return np.clip(x, 0.0, 1.0)
