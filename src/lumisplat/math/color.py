"""Colour conversions: sRGB transfer function (IEC 61966-2-1), CIE luminance and L*a*b* under D65, albedos in gamut."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE
from lumisplat.math.arrays import Doubles


def decode_srgb(encoded: npt.ArrayLike) -> npt.NDArray[np.floating]:
    """Converts display-referred sRGB values to linear ones, as an odd function without clamping.

    Values below 0 and above 1 therefore survive a round trip.
    """
    encoded = np.asarray(encoded)
    encoded = encoded if encoded.dtype.kind == "f" else encoded.astype(np.float32)
    magnitude = np.abs(encoded)
    linear = np.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, encoded).astype(encoded.dtype)


def encode_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.floating]:
    """Converts linear values to display-referred sRGB, as an odd function without clamping."""
    linear = np.asarray(linear)
    linear = linear if linear.dtype.kind == "f" else linear.astype(np.float32)
    magnitude = np.abs(linear)
    encoded = np.where(magnitude <= 0.0031308, magnitude * 12.92, 1.055 * magnitude ** (1.0 / 2.4) - 0.055)
    return np.copysign(encoded, linear).astype(linear.dtype)


def decode_slope(encoded: npt.ArrayLike) -> Doubles:
    """Returns the derivative of `decode_srgb`; its reciprocal is that of `encode_srgb` at the linear value."""
    magnitude = np.abs(np.asarray(encoded, np.float64))
    return np.where(magnitude <= 0.04045, 1.0 / 12.92, 2.4 / 1.055 * ((magnitude + 0.055) / 1.055) ** 1.4)


def albedo_in_range(albedo: Doubles) -> Doubles:
    """Scales albedos with a channel above 1 down until their largest channel is 1; shape (N, 3) for N albedos.

    All channels of an albedo are scaled by one factor, which keeps the hue: an albedo above 1 usually means that the
    light was underestimated by one factor. Clipping each channel would desaturate the colour.
    """
    return albedo / np.maximum(albedo.max(axis=1, keepdims=True), 1.0)


# IEC 61966-2-1: XYZ from linear Rec.709, which also gives the white point of D65.
XYZ_FROM_REC709 = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_WHITE = XYZ_FROM_REC709.sum(axis=1)
_KNEE = 6.0 / 29.0
"""6/29, the cube root of CIE 15's epsilon. For values below epsilon, the curve of L*a*b* is linear."""


def luminance(linear: npt.ArrayLike) -> Doubles:
    """Returns CIE Y of linear Rec.709 values, 1 for white: shape (..., 3) to (...)."""
    return np.asarray(linear, np.float64) @ np.asarray(LUMINANCE)


def lab(linear: npt.ArrayLike) -> Doubles:
    """Converts non-negative linear Rec.709 values, shape (..., 3), to CIE L*a*b* under D65. Grey has a* = b* = 0."""
    relative: Doubles = np.asarray(linear, np.float64) @ (XYZ_FROM_REC709 / _WHITE[:, None]).T
    straight = relative / (3.0 * _KNEE**2) + 4.0 / 29.0
    curved = np.where(relative > _KNEE**3, np.cbrt(relative), straight)
    x, y, z = np.moveaxis(curved, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)
