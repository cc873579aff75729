"""The sRGB transfer function (IEC 61966-2-1), between display-referred and linear Rec.709 values; albedos in range."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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
