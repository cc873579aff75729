"""Colours as people pick them."""

from __future__ import annotations

import math

Color = tuple[float, float, float]

KELVIN_RANGE = (1500.0, 12000.0)
"""From a candle to a blue sky, kelvins."""

# Krystek 1985, "An algorithm to calculate correlated colour temperature", CIE 1960 (u, v), 1000 to 15000 K.
_U = ((0.860117757, 1.54118254e-4, 1.28641212e-7), (1.0, 8.42420235e-4, 7.08145163e-7))
_V = ((0.317398726, 4.22806245e-5, 4.20481691e-8), (1.0, -2.89741816e-5, 1.61456053e-7))

_REC709_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def color_of_temperature(kelvins: float) -> Color:
    """The colour of a black body, linear Rec.709, its largest channel 1, none below 0.

    Args:
        kelvins: Its temperature, 1000 to 15000.
    """
    u, v = (_ratio(table, kelvins) for table in (_U, _V))
    x, y = (3.0 * u / (2.0 * u - 8.0 * v + 4.0), 2.0 * v / (2.0 * u - 8.0 * v + 4.0))
    xyz = (x / y, 1.0, (1.0 - x - y) / y)
    channels = [max(sum(m * c for m, c in zip(row, xyz, strict=True)), 0.0) for row in _REC709_FROM_XYZ]
    red, green, blue = (channel / max(channels) for channel in channels)
    return red, green, blue


def picked_from_linear(color: Color) -> tuple[int, int, int]:
    """A linear colour as the bytes of a colour picker, sRGB; what is brighter than white is white."""
    red, green, blue = (round(255.0 * _encoded(min(max(channel, 0.0), 1.0))) for channel in color)
    return red, green, blue


def linear_from_picked(picked: tuple[int, int, int]) -> Color:
    """The bytes of a colour picker as a linear colour, rounded to five digits, as people write them."""
    red, green, blue = (round(_decoded(channel / 255.0), 5) for channel in picked)
    return red, green, blue


def _ratio(table: tuple[tuple[float, ...], tuple[float, ...]], t: float) -> float:
    above, below = (sum(factor * t**power for power, factor in enumerate(row)) for row in table)
    return above / below


def _encoded(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * math.pow(linear, 1.0 / 2.4) - 0.055


def _decoded(encoded: float) -> float:
    return encoded / 12.92 if encoded <= 0.04045 else math.pow((encoded + 0.055) / 1.055, 2.4)
