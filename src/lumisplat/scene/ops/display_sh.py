"""Harmonics of linear colours as harmonics of display-referred ones, which captures have."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions, sh_basis

_DIRECTIONS_PER_COEFFICIENT = 8
"""Directions in which colours are compared, for each coefficient: the root mean square stays as with twice as many."""
_STEP = 4096
"""Gaussians that are converted together."""


def display_sh(linear_sh: npt.NDArray[np.floating]) -> FloatArray:
    """The harmonics whose colours are nearest to the sRGB encoding of the colours ``max(SH + 0.5, 0)`` of others.

    Nearest in the mean square over all directions. A single coefficient is converted exactly.

    Args:
        linear_sh: Harmonics of linear Rec.709 colours, shape (N, K, 3).

    Returns:
        Harmonics of sRGB colours, shape (N, K, 3).
    """
    count, coefficients, _ = linear_sh.shape
    converted = np.empty(linear_sh.shape, np.float32)
    if coefficients == 1:
        colors = np.maximum(SH_C0 * linear_sh.astype(np.float64) + 0.5, 0.0)
        return ((encode_srgb(colors) - 0.5) / SH_C0).astype(np.float32)
    degree = round(coefficients**0.5) - 1
    basis = sh_basis(even_directions(_DIRECTIONS_PER_COEFFICIENT * coefficients), degree)
    fit = np.linalg.pinv(basis)
    for start in range(0, count, _STEP):
        rows = slice(start, start + _STEP)
        colors = np.maximum(
            np.einsum("dk,nkc->ndc", basis, linear_sh[rows].astype(np.float64), optimize=True) + 0.5, 0.0
        )
        converted[rows] = np.einsum("kd,ndc->nkc", fit, encode_srgb(colors) - 0.5, optimize=True)
    return converted
