"""Tests of the sRGB transfer function on the device."""

from __future__ import annotations

import numpy as np

from lumisplat.device.math import color
from lumisplat.math.color import decode_srgb


def test_device_srgb_decoding_matches_the_standard() -> None:
    """Decoding is accurate to one millionth in the linear segment, the polynomial segment and above 1."""
    values = np.concatenate([np.linspace(0.0, 0.05, 40), np.linspace(0.05, 1.0, 160), np.linspace(1.0, 2.0, 40)])
    decoded = [color.decode_srgb(float(v)) for v in values.astype(np.float32)]
    np.testing.assert_allclose(decoded, decode_srgb(values.astype(np.float32).astype(np.float64)), rtol=1e-6)
