"""Real spherical harmonics of any degree, in the order and with the signs that captures use (Kerbl et al. 2023)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0

_Floats = npt.NDArray[np.floating]

# Square roots of 3/4; of 15/4, 5/16, 15/16; of 35/32, 105/4, 21/32, 7/16, 105/16; all over pi.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)

_IMAGINARY_STEP = 1e-100
"""Imaginary step of `sh_gradient`, whose square is 0 beside any value of float64."""

_ROTATED_AT_ONCE = 8192
"""Number of functions that `rotate_sh` rotates at once: their basis values fit the CPU cache."""


def sh_basis(directions: npt.ArrayLike, degree: int, dtype: type[np.floating] = np.float64) -> _Floats:
    """Evaluates the real spherical harmonics, which are orthonormal over the sphere.

    Function ``l^2 + l + m`` is ``Y_lm`` with the Condon-Shortley phase ``(-1)^m``: m > 0 goes with the cosine of the
    angle about z, m < 0 with the sine. Captures store at most degree 3; probes go further.

    Args:
        directions: Unit vectors, shape (..., 3).
        degree: Highest degree, at least 0.
        dtype: Precision of the computation and of the result.

    Returns:
        Shape (..., (degree + 1)^2), the constant function first.
    """
    return _functions(np.asarray(directions, dtype), degree)


def sh_gradient(directions: npt.ArrayLike, degree: int) -> npt.NDArray[np.float64]:
    """Evaluates the gradients of the real spherical harmonics over the sphere, exact to rounding.

    The functions are polynomials of x, y and z. Their derivative is the imaginary part for a tiny imaginary step, which
    cancels nothing (Squire and Trapp 1998: Using Complex Variables to Estimate Derivatives of Real Functions).

    Args:
        directions: Unit vectors, shape (..., 3).
        degree: As for `sh_basis`.

    Returns:
        Gradients of the K functions, perpendicular to the direction, shape (..., K, 3).
    """
    along = np.asarray(directions, np.float64)
    steps = 1j * _IMAGINARY_STEP * np.eye(3)
    slopes = np.stack([np.imag(_functions(along + step, degree)) for step in steps], axis=-1) / _IMAGINARY_STEP
    return slopes - (slopes @ along[..., None]) * along[..., None, :]


def even_directions(count: int) -> npt.NDArray[np.float64]:
    """Returns unit directions spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    steps = np.arange(count) + 0.5
    z = 1.0 - 2.0 * steps / count
    angle, ring = np.pi * (1.0 + np.sqrt(5.0)) * steps, np.sqrt(1.0 - z * z)
    return np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])


def sh_rotation(rotation: npt.NDArray[np.floating], degree: int) -> npt.NDArray[np.float64]:
    """Returns the matrix that rotates SH coefficients: rotated coefficients = matrix @ coefficients.

    The rotated function has at R d the value that the original function has at d. Rotation does not mix degrees.
    Function values in more directions than there are coefficients therefore determine the matrix, up to rounding.

    Args:
        rotation: Rotation R, shape (3, 3).
        degree: Highest degree, at least 0.

    Returns:
        Orthogonal matrix, shape (K, K), K = (degree + 1)^2, with one block for each degree.
    """
    count = (degree + 1) ** 2
    turned = np.zeros((count, count))
    directions = even_directions(4 * count)
    before, after = sh_basis(directions, degree), sh_basis(directions @ np.asarray(rotation, np.float64).T, degree)
    for level in range(degree + 1):
        band = slice(level**2, (level + 1) ** 2)
        turned[band, band] = np.linalg.lstsq(after[:, band], before[:, band])[0]
    return turned


def rotate_sh(sh: npt.ArrayLike, rotations: npt.ArrayLike) -> _Floats:
    """Rotates the SH coefficients of N functions, each by a rotation of its own.

    Each rotated function has at R d the value that the original has at d. A band of degree l is determined by its
    values in 2 l + 1 directions: the values of the original in the directions ``R^T d``.

    Args:
        sh: Coefficients, shape (N, K, C) for K = (degree + 1)^2 and C channels.
        rotations: Rotations R, shape (N, 3, 3).

    Returns:
        Rotated coefficients in the precision of ``sh``, shape (N, K, C).
    """
    coefficients, turns = np.asarray(sh), np.asarray(rotations)
    rotated = np.array(coefficients)
    for first in range(0, len(rotated), _ROTATED_AT_ONCE):
        rows = slice(first, first + _ROTATED_AT_ONCE)
        for level in range(1, math.isqrt(rotated.shape[1])):
            band = slice(level**2, (level + 1) ** 2)
            count = 2 * level + 1
            directions = even_directions(4 * count)[:count]  # on one cap: opposite directions would repeat values
            from_values = np.linalg.inv(sh_basis(directions, level)[:, band])
            before = directions @ turns[rows]  # row vectors: d^T R = (R^T d)^T
            basis = sh_basis(before, level, coefficients.dtype.type)[..., band]
            rotated[rows, band] = from_values.astype(coefficients.dtype) @ (basis @ coefficients[rows, band])
    return rotated


def _functions(directions: npt.NDArray[Any], degree: int) -> npt.NDArray[Any]:
    """Evaluates the basis functions in the precision of the directions, also of complex ones."""
    x, y, z = np.moveaxis(directions, -1, 0)
    functions = _polynomials(x, y, z, degree)
    if degree > 3:
        functions += _recurrence(x, y, z, degree)
    return np.moveaxis(np.array(functions), 0, -1)


def _polynomials(x: _Floats, y: _Floats, z: _Floats, degree: int) -> list[_Floats]:
    """Evaluates the basis functions up to degree 3, or ``degree`` if that is lower, as polynomials."""
    functions = [np.full_like(x, SH_C0)]
    if degree >= 1:
        functions += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        a, b, c = _C2
        functions += [a * x * y, -a * y * z, b * (3.0 * z * z - 1.0), -a * x * z, c * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e = _C3
        wide = 5.0 * z * z - 1.0
        functions += [
            -a * y * (3.0 * x * x - y * y),
            b * x * y * z,
            -c * y * wide,
            d * z * (wide - 2.0),
            -c * x * wide,
            e * z * (x * x - y * y),
            -a * x * (x * x - 3.0 * y * y),
        ]
    return functions


def _recurrence(x: _Floats, y: _Floats, z: _Floats, degree: int) -> list[_Floats]:
    """Evaluates the basis functions of degree 4 to ``degree`` by the recurrence of Legendre functions in l."""
    functions = {}
    # Cosine and sine of m times the angle, times sin(theta)^m, are the parts of (x + i y)^m.
    cosine, sine = np.ones_like(x), np.zeros_like(x)
    start = SH_C0
    for m in range(degree + 1):
        if m > 0:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
            start *= -math.sqrt((2 * m + 1) / (2 * m))
        before, legendre = np.zeros_like(z), np.full_like(z, start)
        for level in range(m, degree + 1):
            if level > m:
                before, legendre = legendre, _next_legendre(level, m, z, legendre, before)
            if m == 0:
                functions[level, 0] = legendre
            else:
                functions[level, m] = math.sqrt(2.0) * legendre * cosine
                functions[level, -m] = math.sqrt(2.0) * legendre * sine
    return [functions[level, m] for level in range(4, degree + 1) for m in range(-level, level + 1)]


def _next_legendre(level: int, m: int, z: _Floats, last: _Floats, before: _Floats) -> _Floats:
    """Returns the normalised Legendre function ``P_level^m`` by recurrence from the two degrees below.

    ``last`` is the function of degree ``level - 1``, ``before`` the function of degree ``level - 2``.
    """
    outer = math.sqrt((4 * level**2 - 1) / (level**2 - m**2))
    inner = math.sqrt(((level - 1) ** 2 - m**2) / (4 * (level - 1) ** 2 - 1))
    return outer * (z * last - inner * before)
