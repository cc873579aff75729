"""How near found albedo, normals and environments are to true ones (docs/guide/materials.md#figures)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, host_array
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions, panorama_lookup, panorama_solid_angles

BLACK = 0.0015
"""Linear values below this, 5 of 255 on a display, are black: their ratios to others tell nothing of a scale."""

LIT_SHARE = 0.02
"""Share of what counts that is not black, below which a channel is black: a few stray pixels are no median of it."""

ENVIRONMENT_ROWS = 16
"""Rows at which environments are compared: those of R3DG's, which are 16 x 32."""

Channels = tuple[float, float, float]


def channel_scale(found: npt.ArrayLike, truth: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> Channels:
    """The factor of each channel by which found colours are as bright as true ones: the median of the ratios.

    What light gives and what surfaces reflect are only known as products, so that one factor a channel is nobody's
    fault. The median is that of TensoIR (Jin et al. 2023), GS-IR and R3DG, but for what is black in either, which does
    not count here.

    Args:
        found: Linear colours, shape (N, 3).
        truth: Linear colours, shape (N, 3).
        weights: How much each of them counts, shape (N,); None: all the same.

    Returns:
        1 for a channel that is black, but for less than a fiftieth of what counts.
    """
    given, wanted = np.asarray(host_array(found), np.float64), np.asarray(host_array(truth), np.float64)
    shares = np.ones(len(given)) if weights is None else np.asarray(host_array(weights), np.float64)
    counted = shares[:, None] * (np.minimum(given, wanted) >= BLACK)
    counted *= counted.sum(axis=0) >= LIT_SHARE * shares.sum()
    ratios = np.divide(wanted, given, out=np.ones_like(given), where=given >= BLACK)
    red, green, blue = (_weighted_median(ratios[:, channel], counted[:, channel]) for channel in range(3))
    return red, green, blue


def normal_errors(found: npt.ArrayLike, truth: npt.ArrayLike) -> Doubles:
    """Angles between normals, degrees, shape (N,); 90 where there is none.

    Args:
        found: Shape (N, 3), of any length; zero: none was found.
        truth: Unit normals, shape (N, 3).
    """
    normals, wanted = np.asarray(host_array(found), np.float64), np.asarray(host_array(truth), np.float64)
    # Of the half angle, as rounding makes arc cosines of nearly equal directions as large as 0.02 degrees.
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    apart, along = (np.linalg.norm(unit + sign * wanted, axis=-1) for sign in (-1.0, 1.0))
    return np.degrees(np.where(lengths[..., 0] > 0.0, 2.0 * np.arctan2(apart, along), 0.5 * np.pi))


def environment_psnr(found: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Peak signal-to-noise ratio of a panorama after one scale a channel, dB; directions count by solid angle.

    Both are reduced to 16 x 32 directions, the resolution of R3DG's, by means over solid angle; the scale is the
    weighted median of ratios, as `channel_scale`; what is compared is display-referred, clipped at 1.

    Args:
        found: Linear radiance, shape (H, W, 3), with the axes of `LightEnvironment`.
        truth: The same of any size, as exposed as photographs in its light.
    """
    weights = np.repeat(panorama_solid_angles(ENVIRONMENT_ROWS, 2 * ENVIRONMENT_ROWS), 2 * ENVIRONMENT_ROWS)
    tested, wanted = (_coarse(np.asarray(host_array(image), np.float64)).reshape(-1, 3) for image in (found, truth))
    tested = tested * channel_scale(tested, wanted, weights)
    errors = (encode_srgb(np.clip(tested, 0.0, 1.0)) - encode_srgb(np.clip(wanted, 0.0, 1.0))) ** 2
    error = float(np.average(errors.mean(axis=1), weights=weights))
    return float("inf") if error == 0.0 else -10.0 * np.log10(error).item()


def _weighted_median(values: Doubles, weights: Doubles) -> float:
    """The value up to which half of the weight lies; the mean of two where exactly half of it does; 1 without any."""
    if weights.sum() == 0.0:
        return 1.0
    order = np.argsort(values, kind="stable")
    ordered, shares = values[order], np.cumsum(weights[order]) / weights.sum()
    index = int(np.searchsorted(shares, 0.5 - 1e-12))
    ends_here = abs(shares[index] - 0.5) < 1e-12 and index + 1 < len(ordered)
    return float(0.5 * (ordered[index] + ordered[index + 1]) if ends_here else ordered[index])


def _coarse(image: Doubles) -> Doubles:
    """Means over the directions of 16 x 32 pixels, by lookups on a grid that no pixel of the image slips through."""
    height = ENVIRONMENT_ROWS
    fine = -(-max(image.shape[0], image.shape[1] // 2, 4 * height) // height)
    looked_up = panorama_lookup(image, panorama_directions(height * fine, 2 * height * fine))
    angles = panorama_solid_angles(height * fine, 2 * height * fine).reshape(height, fine)
    columns = looked_up.reshape(height, fine, 2 * height, fine, 3).mean(axis=3)
    return np.einsum("hfwc,hf->hwc", columns, angles / angles.sum(axis=1, keepdims=True))
