"""Display-referred colours of Gaussians under more or less light (docs/method/gaussians.md#colour)."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lumisplat.constants import RECOLOR_DARK, SH_C0
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, float_array, read_only_view, refuse_rows
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import SplatInstance

Subject = TypeVar("Subject", Gaussians, SplatInstance)
"""What is relit or shadowed: a function returns the kind that it was given."""


def scale_light(gaussians: Gaussians, factors: npt.ArrayLike) -> Gaussians:
    """The same Gaussians, each under ``factors`` times as much light.

    Light is linear, colours are display-referred. The display gain of a channel is ``g = encode(f decode(c)) / c`` at
    the mean colour ``c`` over all directions, and the colour from every direction, ``max(SH + 0.5, 0)``, is multiplied
    by it. So the mean colour changes by exactly the factor of light, and highlights keep their contrast.

    Args:
        gaussians: Any Gaussians.
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


def scale_light_of(subject: Subject, factors: npt.NDArray[np.floating]) -> Subject:
    """A subject under ``factors`` of its light, shape (N, 3), see `scale_light`; the same object if all are 1."""
    if isinstance(subject, Gaussians):
        return scale_light(subject, factors)
    scaled = scale_light(subject.gaussians, factors)
    return subject if scaled is subject.gaussians else replace(subject, gaussians=scaled)


def base_colors(gaussians: Gaussians) -> npt.NDArray[np.float64]:
    """What Gaussians reflect by, linear, shape (N, 3): their albedo, else the mean of what was captured, decoded."""
    if gaussians.albedo is not None:
        return gaussians.albedo.astype(np.float64)
    return decode_srgb(np.maximum(SH_C0 * gaussians.sh[:, 0].astype(np.float64) + 0.5, 0.0)).astype(np.float64)


def _scale_sh(sh: FloatArray, factors: FloatArray) -> FloatArray:
    """SH, shape (M, K, 3), under light scaled by ``factors``, shape (M, 3)."""
    wide = sh.astype(np.float64)
    # Towards black the gain tends to the factor itself, because the sRGB curve is straight there.
    mean = np.maximum(SH_C0 * wide[:, 0] + 0.5, RECOLOR_DARK)
    gains = encode_srgb(factors * decode_srgb(mean)) / mean
    scaled = gains[:, None, :] * wide
    scaled[:, 0] += (gains - 1.0) * (0.5 / SH_C0)
    return np.where(factors[:, None, :] == 1.0, sh, scaled.astype(np.float32))
