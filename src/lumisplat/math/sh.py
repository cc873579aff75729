"""Real spherical harmonics of any degree, in the order and with the signs of captures (Kerbl et al. 2023).

Captures end at degree 3, and have their polynomials in `lumisplat.scene.ops.sh_colors`; probes go on.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_Doubles = npt.NDArray[np.float64]


def sh_basis(directions: npt.ArrayLike, degree: int) -> _Doubles:
    """Values of the basis functions: orthonormal over the sphere, constant first.

    Function ``l^2 + l + m`` is ``Y_lm``, with the Condon-Shortley phase ``(-1)^m``; m > 0 goes with the cosine of the
    angle about z, m < 0 with the sine. Up to degree 3 they are those of captures, so that coefficients mean
    the same.

    Args:
        directions: Unit vectors, shape (..., 3).
        degree: Highest degree, at least 0.

    Returns:
        Shape (..., (degree + 1)^2), float64.
    """
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    basis = np.empty((*z.shape, (degree + 1) ** 2))
    # Cosine and sine of m times the angle are powers of x + i y, times sin(theta)^m: Legendre functions lack that.
    cosine, sine = np.ones_like(z), np.zeros_like(z)
    start = math.sqrt(0.25 / math.pi)
    for m in range(degree + 1):
        if m:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            start *= math.sqrt((2 * m + 1) / (2 * m))
        before, legendre = np.zeros_like(z), np.full_like(z, start)
        for level in range(m, degree + 1):
            if level > m:
                before, legendre = legendre, _next_legendre(level, m, z, legendre, before)
            center = level * level + level
            if m == 0:
                basis[..., center] = legendre
            else:
                signed = ((-1) ** m * math.sqrt(2.0)) * legendre
                basis[..., center + m] = signed * cosine
                basis[..., center - m] = signed * sine
    return basis


def _next_legendre(level: int, m: int, z: _Doubles, last: _Doubles, before: _Doubles) -> _Doubles:
    """Normalised ``P_level^m`` from those one and two levels lower (recurrence in the degree)."""
    outer = math.sqrt((4 * level**2 - 1) / (level**2 - m**2))
    inner = math.sqrt(((level - 1) ** 2 - m**2) / (4 * (level - 1) ** 2 - 1))
    return outer * (z * last - inner * before)
