"""Colours of Gaussians from SH in display space (Kerbl et al. 2023), and scaling of captured light by linear factors.

See docs/method/gaussians.md#colour.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.constants import SH_C0, SH_DEGREE_MAX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, float_array, read_only_view, refuse_rows
from lumisplat.math.color import decode_slope, decode_srgb, encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import SplatInstance

RECOLOR_DARK = 1e-4
"""Smallest display-referred mean colour by which `scale_light` divides; darker ones are clamped to this value. The
value lies far inside the linear part of the sRGB curve (below 0.04), where the display gain equals the linear factor.
It is also far above float32's rounding of 0.5 (6e-8)."""

_DIRECTIONS_PER_COEFFICIENT = 8
"""Sample directions per SH coefficient when SH are fitted: twice as many give the same root mean square error."""
_STEP = 4096
"""Number of Gaussians whose SH `display_sh` converts at once."""

Subject = TypeVar("Subject", Gaussians, SplatInstance)
"""`Gaussians` or `SplatInstance`; a function that is given one of the two returns an object of the same type."""


def colors_along(gaussians: Gaussians, directions: npt.NDArray[np.floating], degree: int = SH_DEGREE_MAX) -> FloatArray:
    """Evaluates display-referred colours ``max(SH + 0.5, 0)`` along directions from the eye to the means.

    Args:
        gaussians: N Gaussians.
        directions: Unit vectors in the Gaussians' object space, shape (N, 3).
        degree: Highest SH degree to evaluate, 0 to 3.

    Returns:
        Display-referred colours, shape (N, 3).
    """
    basis = sh_basis(directions, min(degree, gaussians.sh_degree), np.float32)
    # A small matrix product per Gaussian makes one pass over its contiguous coefficients.
    sums = (basis[:, None, :] @ gaussians.sh[:, : basis.shape[1]])[:, 0]
    return np.maximum(sums + np.float32(0.5), 0.0)


def display_sh(linear_sh: npt.NDArray[np.floating]) -> FloatArray:
    """Converts SH of linear colours to SH of sRGB colours, by least squares over all directions.

    The linear colours are ``max(given SH sum + 0.5, 0)``. The returned SH sum plus 0.5 fits their sRGB encoding. A
    single coefficient is converted exactly.

    Args:
        linear_sh: SH of linear Rec.709 colours of N Gaussians, K coefficients per channel, shape (N, K, 3).

    Returns:
        SH of sRGB colours, shape (N, K, 3).
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


def scale_light(gaussians: Gaussians, factors: npt.ArrayLike) -> Gaussians:
    """Scales the captured light of each Gaussian by a linear factor.

    Light is linear, while colours are display-referred. For a channel's mean colour ``c`` over all directions and
    factor ``f``, the display gain is ``g = encode(f decode(c)) / c``; the colour ``max(SH + 0.5, 0)`` of every
    direction is multiplied by ``g``. The mean colour thus changes by exactly the factor of light, and highlights keep
    their contrast.

    Args:
        gaussians: N Gaussians.
        factors: Linear-light factors, at least 0, one per Gaussian, shape (N,), or one per channel, shape (N, 3).

    Returns:
        Gaussians that differ in ``sh`` only; all other arrays are the same objects. Colours with a factor of exactly 1
        keep their bits; if all factors are 1, this is ``gaussians`` itself.

    Raises:
        SceneError: ``factors`` has another shape, or negative or non-finite values (the message counts them).
    """
    checked = float_array("factors", factors)
    count = gaussians.count
    if checked.shape not in ((count,), (count, 3)):
        raise SceneError(f"factors has shape {checked.shape}, expected ({count},) or ({count}, 3)")
    per_channel = np.broadcast_to(checked.reshape(count, -1), (count, 3))
    refuse_rows("factors", "negative", np.asarray((per_channel < 0.0).any(axis=1)))
    rows = np.flatnonzero((per_channel != 1.0).any(axis=1))
    if rows.size == 0:
        return gaussians
    sh = gaussians.sh.copy()
    sh[rows] = _scale_sh(gaussians.sh[rows], per_channel[rows])
    return replace(gaussians, sh=read_only_view(sh))


def scale_light_gradient(
    gaussians: Gaussians, factors: npt.NDArray[np.floating], by_sh: Doubles
) -> tuple[Doubles, Doubles]:
    """Returns the gradients of a loss by the factors and by the captured SH of `scale_light`.

    Mean colours below `RECOLOR_DARK` count as constant.

    Args:
        gaussians: N Gaussians.
        factors: Linear-light factors of their channels, shape (N, 3).
        by_sh: Gradient of the loss by the scaled SH, shape (N, K, 3).

    Returns:
        Gradients by the factors, shape (N, 3), and by the SH, shape (N, K, 3).
    """
    captured = gaussians.sh.astype(np.float64)
    color = SH_C0 * captured[:, 0] + 0.5
    mean = np.maximum(color, RECOLOR_DARK)
    shown = encode_srgb(factors * decode_srgb(mean))
    gains, encode_slope = shown / mean, 1.0 / decode_slope(shown)
    by_gains = (by_sh * captured).sum(axis=1) + (0.5 / SH_C0) * by_sh[:, 0]
    by_mean = by_gains * (encode_slope * factors * decode_slope(mean) - gains) / mean
    by_captured = gains[:, None, :] * by_sh
    by_captured[:, 0] += SH_C0 * np.where(color > RECOLOR_DARK, by_mean, 0.0)
    return by_gains * encode_slope * decode_srgb(mean) / mean, by_captured


def scale_light_of(subject: Subject, factors: npt.NDArray[np.floating]) -> Subject:
    """Scales the captured light of Gaussians or of an instance by linear factors, shape (N, 3); see `scale_light`."""
    if isinstance(subject, Gaussians):
        return scale_light(subject, factors)
    scaled = scale_light(subject.gaussians, factors)
    return subject if scaled is subject.gaussians else replace(subject, gaussians=scaled)


def base_colors(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """Returns the linear albedo of N Gaussians, (N, 3), or without an albedo their decoded mean captured colour."""
    if gaussians.albedo is not None:
        return gaussians.albedo.astype(np.float64)
    return decode_srgb(np.maximum(SH_C0 * gaussians.sh[:, 0].astype(np.float64) + 0.5, 0.0)).astype(np.float64)


def _scale_sh(sh: FloatArray, factors: FloatArray) -> FloatArray:
    """Scales the captured light of M Gaussians' SH, shape (M, K, 3), by linear factors, shape (M, 3)."""
    wide = sh.astype(np.float64)
    # Towards black the gain tends to the factor, because the sRGB curve is linear there.
    mean = np.maximum(SH_C0 * wide[:, 0] + 0.5, RECOLOR_DARK)
    gains = encode_srgb(factors * decode_srgb(mean)) / mean
    scaled = gains[:, None, :] * wide
    scaled[:, 0] += (gains - 1.0) * (0.5 / SH_C0)
    return np.where(factors[:, None, :] == 1.0, sh, scaled.astype(np.float32))
