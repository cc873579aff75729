"""The noise of a frame, from the relative errors of its pixels (docs/method/samples.md)."""

from __future__ import annotations

import math

import numpy as np

from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb
from lumisplat.math.tone_map import exposure_gain

NOISE_LUMINANCE_MIN = 0.01
"""Linear luminance, after exposure, below which errors are no longer relative: 2 % of it are a third of a step of 8
bits in display space."""


def least_luminance(exposure: float, *, is_lit: bool) -> float:
    """The luminance that errors of darker pixels are relative to, in the colours of a frame."""
    if is_lit:
        return NOISE_LUMINANCE_MIN / exposure_gain(exposure)
    return float(encode_srgb(np.float32(NOISE_LUMINANCE_MIN)))


def quantile(values: FloatArray, share: float) -> float:
    """The smallest value that a share of all values are not above; NaN: there are none."""
    if not values.size:
        return math.nan
    place = math.ceil(share * values.size) - 1
    return float(np.partition(values, place)[place])
