"""From pictures back to linear light: the inverse of each tone mapper, but for what was clipped."""

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
)
from lumisplat.math.arrays import Doubles
from lumisplat.math.color import decode_srgb
from lumisplat.math.tone_map import AGX_FROM_REC709, REC709_FROM_REC2020, REC2020_FROM_AGX

_WHITE = 1.0 - 1e-6
"""Just below what a display can show: beyond, curves have no inverse."""


def remove_tone_map(display: npt.ArrayLike, tone_map: ToneMap) -> Doubles:
    """Linear light of display colours: what `lumisplat.math.tone_map.apply_tone_map` maps to them.

    Args:
        display: sRGB, 0..1, shape (..., 3). What is clipped at 0 or 1 comes back as the end of the range.
        tone_map: Which curve they went through.

    Returns:
        Linear Rec.709 with the exposure applied, at least 0, shape (..., 3), float64.
    """
    light = decode_srgb(np.clip(np.asarray(display, np.float64), 0.0, 1.0))
    if tone_map is ToneMap.NEUTRAL:
        light = _without_neutral(light)
    elif tone_map is ToneMap.AGX:
        light = _without_agx(light)
    return np.maximum(light, 0.0)


def _without_neutral(shown: npt.NDArray[np.floating]) -> Doubles:
    """The inverse of Khronos PBR Neutral."""
    peak = np.minimum(shown.max(axis=-1, keepdims=True), _WHITE)
    room = 1.0 - NEUTRAL_START
    bright = np.maximum(peak, NEUTRAL_START)
    before = room**2 / (1.0 - bright) - room + NEUTRAL_START
    saturation = 1.0 / (NEUTRAL_DESATURATION * (before - bright) + 1.0)
    color = (bright + (shown - bright) / saturation) * (before / bright)
    color = np.where(peak < NEUTRAL_START, shown, color)
    least = np.maximum(color.min(axis=-1, keepdims=True), 0.0)
    taken = np.where(least <= NEUTRAL_TOE, np.sqrt(4.0 * NEUTRAL_TOE * least) - least, NEUTRAL_TOE)
    return np.asarray(color + taken, np.float64)


def _without_agx(shown: npt.NDArray[np.floating]) -> Doubles:
    """The inverse of AgX."""
    low, high = AGX_STOPS
    rec2020 = np.maximum(shown @ np.linalg.inv(REC709_FROM_REC2020.astype(np.float64)).T, 0.0)
    curved = rec2020 ** (1.0 / AGX_GAMMA) @ np.linalg.inv(REC2020_FROM_AGX.astype(np.float64)).T
    stops = low + (high - low) * _before_agx_curve(curved)
    return np.asarray(2.0**stops @ np.linalg.inv(AGX_FROM_REC709.astype(np.float64)).T, np.float64)


def _before_agx_curve(curved: npt.NDArray[np.floating]) -> Doubles:
    """The inverse of the sigmoid, 0..1."""
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
