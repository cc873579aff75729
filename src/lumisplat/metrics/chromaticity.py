"""CIE colour: luminance, and L*a*b* under D65."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LUMINANCE

Values = npt.NDArray[np.float64]

# IEC 61966-2-1: XYZ from linear Rec.709, which also gives the white point of D65.
_XYZ_FROM_REC709 = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_WHITE = _XYZ_FROM_REC709.sum(axis=1)
_KNEE = 6.0 / 29.0
"""Below the cube of this, the cube root of L*a*b* becomes a straight line (CIE 15 calls the cube epsilon)."""


def luminance(linear: npt.ArrayLike) -> Values:
    """CIE Y of linear Rec.709 values, white is 1: shape (..., 3) to (...)."""
    return np.asarray(linear, np.float64) @ np.asarray(LUMINANCE)


def lab(linear: npt.ArrayLike) -> Values:
    """CIE L*a*b* under D65 of linear Rec.709 values of at least 0, shape (..., 3). Grey has a* = b* = 0."""
    relative: Values = np.asarray(linear, np.float64) @ (_XYZ_FROM_REC709 / _WHITE[:, None]).T
    straight = relative / (3.0 * _KNEE**2) + 4.0 / 29.0
    curved = np.where(relative > _KNEE**3, np.cbrt(relative), straight)
    x, y, z = np.moveaxis(curved, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)
