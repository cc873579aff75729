"""How lit frames become pictures: exposure, tone mapping, and what was captured."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.scene.arrays import FloatArray
from lumisplat.scene.color import decode_srgb


def captured_radiance(captured: npt.ArrayLike, weight: npt.ArrayLike) -> FloatArray:
    """Linear Rec.709 of what was captured: un-premultiplied, decoded and weighted again.

    Args:
        captured: Display-referred sRGB premultiplied by ``weight``, shape (..., 3).
        weight: Its share of the pixel, 0..1, shape (...).

    Returns:
        Shape (..., 3); zero where ``weight`` is.
    """
    captured, share = np.asarray(captured, np.float32), np.asarray(weight, np.float32)[..., None]
    straight = np.divide(captured, share, out=np.zeros_like(captured), where=share > 0.0)
    return decode_srgb(straight) * share
