"""Converts colors: the sRGB transfer function (IEC 61966-2-1), CIE luminance and L*a*b* under D65; albedos in range."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE
from lumisplat.math.arrays import Doubles


def decode_srgb(encoded: npt.ArrayLike) -> npt.NDArray[np.floating]:
    """Linear values of display-referred ones. Odd-symmetric and unclamped, so that round trips lose nothing."""
    encoded = np.asarray(encoded)
    encoded = encoded if encoded.dtype.kind == "f" else encoded.astype(np.float32)
    magnitude = np.abs(encoded)
    linear = np.where(magnitude <= 0.04045, magnitude / 12.92, ((magnitude + 0.055) / 1.055) ** 2.4)
    return np.copysign(linear, encoded).astype(encoded.dtype)


def encode_srgb(linear: npt.ArrayLike) -> npt.NDArray[np.floating]:
    """Display-referred values of linear ones. Odd-symmetric and unclamped."""
    linear = np.asarray(linear)
    linear = linear if linear.dtype.kind == "f" else linear.astype(np.float32)
    magnitude = np.abs(linear)
    encoded = np.where(magnitude <= 0.0031308, magnitude * 12.92, 1.055 * magnitude ** (1.0 / 2.4) - 0.055)
    return np.copysign(encoded, linear).astype(linear.dtype)


def albedo_in_range(albedo: Doubles) -> Doubles:
    """Albedos of at most 1, shape (N, 3): those above it in a channel are darkened in all, and keep their hue.

    What is missing there is light, mostly by one factor for all channels; cut off one by one, colours would pale.
    """
    return albedo / np.maximum(albedo.max(axis=1, keepdims=True), 1.0)


# IEC 61966-2-1: XYZ from linear Rec.709, which also gives the white point of D65.
_XYZ_FROM_REC709 = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_WHITE = _XYZ_FROM_REC709.sum(axis=1)
_KNEE = 6.0 / 29.0
"""Below the cube of this, the cube root of L*a*b* becomes a straight line (CIE 15 calls the cube epsilon)."""


def luminance(linear: npt.ArrayLike) -> Doubles:
    """CIE Y of linear Rec.709 values, white is 1: shape (..., 3) to (...)."""
    return np.asarray(linear, np.float64) @ np.asarray(LUMINANCE)


def lab(linear: npt.ArrayLike) -> Doubles:
    """CIE L*a*b* under D65 of linear Rec.709 values of at least 0, shape (..., 3). Grey has a* = b* = 0."""
    relative: Doubles = np.asarray(linear, np.float64) @ (_XYZ_FROM_REC709 / _WHITE[:, None]).T
    straight = relative / (3.0 * _KNEE**2) + 4.0 / 29.0
    curved = np.where(relative > _KNEE**3, np.cbrt(relative), straight)
    x, y, z = np.moveaxis(curved, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)
