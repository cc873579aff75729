"""Transfer functions on the device."""

from __future__ import annotations

import numpy as np

from lumisplat.device.math import color
from lumisplat.math.color import decode_srgb


def test_decoding_follows_the_standard() -> None:
    """From black to twice white, to a millionth, in the linear part, the polynomial's, and beyond white."""
    values = np.concatenate([np.linspace(0.0, 0.05, 40), np.linspace(0.05, 1.0, 160), np.linspace(1.0, 2.0, 40)])
    decoded = [color.decode_srgb(float(v)) for v in values.astype(np.float32)]
    np.testing.assert_allclose(decoded, decode_srgb(values.astype(np.float32).astype(np.float64)), rtol=1e-6)
