"""Errors of estimated albedo, normals and environments against ground truth (docs/guide/materials.md#figures)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, host_array
from lumisplat.math.color import encode_srgb
from lumisplat.math.directions import panorama_directions, panorama_lookup, panorama_solid_angles

BLACK = 0.0015
"""Linear value, 5 of 255 on a display, below which colours count as black and their ratios as meaningless."""

LIT_SHARE = 0.02
"""Smallest fraction of the weight that is not black in a channel for `channel_scale` to scale the channel; with less,
the median ratio would depend on a few stray pixels."""

ENVIRONMENT_ROWS = 16
"""Number of pixel rows to which environments are reduced for comparison: 16, with 32 columns, as in R3DG."""

Channels = tuple[float, float, float]


def channel_scale(found: npt.ArrayLike, truth: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> Channels:
    """Returns the factor of each channel that matches estimated colours to ground truth: the median of their ratios.

    Only the product of light and albedo can be estimated, so a factor per channel is no error. The median is that of
    TensoIR (Jin et al. 2023), GS-IR and R3DG, except that colours that are black in either input are left out here.

    Args:
        found: Estimated linear colours, shape (N, 3).
        truth: Ground-truth linear colours, shape (N, 3).
        weights: Weight of each colour, shape (N,); None: equal weights.

    Returns:
        Factors of red, green and blue; 1 for a channel in which less than a fiftieth of the weight is not black.
    """
    given, wanted = np.asarray(host_array(found), np.float64), np.asarray(host_array(truth), np.float64)
    shares = np.ones(len(given)) if weights is None else np.asarray(host_array(weights), np.float64)
    counted = shares[:, None] * (np.minimum(given, wanted) >= BLACK)
    counted *= counted.sum(axis=0) >= LIT_SHARE * shares.sum()
    ratios = np.divide(wanted, given, out=np.ones_like(given), where=given >= BLACK)
    red, green, blue = (_weighted_median(ratios[:, channel], counted[:, channel]) for channel in range(3))
    return red, green, blue


def normal_errors(found: npt.ArrayLike, truth: npt.ArrayLike) -> Doubles:
    """Returns angles between N estimated and true normals, degrees, shape (N,); 90 for missing normals.

    Args:
        found: Estimated normals of any length, shape (N, 3); zero where none was estimated.
        truth: Unit normals, shape (N, 3).
    """
    normals, wanted = np.asarray(host_array(found), np.float64), np.asarray(host_array(truth), np.float64)
    # The half-angle formula is exact for small angles; rounding gives arc cosines errors of up to 0.02 degrees.
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    unit = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0)
    apart, along = (np.linalg.norm(unit + sign * wanted, axis=-1) for sign in (-1.0, 1.0))
    return np.degrees(np.where(lengths[..., 0] > 0.0, 2.0 * np.arctan2(apart, along), 0.5 * np.pi))


def environment_psnr(found: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """Returns the peak signal-to-noise ratio of an environment image, dB, after scaling each channel.

    Errors are weighted by solid angle. Both images are reduced to 16 x 32 directions, the resolution of R3DG's, by
    means over solid angle. The scale is the weighted median of ratios, as in `channel_scale`. Colours are compared
    display-referred, clipped at 1.

    Args:
        found: Estimated linear radiance, shape (H, W, 3), with the axes of `LightEnvironment`.
        truth: Ground truth of any size in the same form, with the exposure of images in its light.
    """
    weights = np.repeat(panorama_solid_angles(ENVIRONMENT_ROWS, 2 * ENVIRONMENT_ROWS), 2 * ENVIRONMENT_ROWS)
    tested, wanted = (_coarse(np.asarray(host_array(image), np.float64)).reshape(-1, 3) for image in (found, truth))
    tested = tested * channel_scale(tested, wanted, weights)
    errors = (encode_srgb(np.clip(tested, 0.0, 1.0)) - encode_srgb(np.clip(wanted, 0.0, 1.0))) ** 2
    error = float(np.average(errors.mean(axis=1), weights=weights))
    return float("inf") if error == 0.0 else -10.0 * np.log10(error).item()


def _weighted_median(values: Doubles, weights: Doubles) -> float:
    """Returns the weighted median of ``values``; 1 if all weights are 0.

    If exactly half of the weight lies below a gap between two values, the result is their mean.
    """
    if weights.sum() == 0.0:
        return 1.0
    order = np.argsort(values, kind="stable")
    ordered, shares = values[order], np.cumsum(weights[order]) / weights.sum()
    index = int(np.searchsorted(shares, 0.5 - 1e-12))
    ends_here = abs(shares[index] - 0.5) < 1e-12 and index + 1 < len(ordered)
    return float(0.5 * (ordered[index] + ordered[index + 1]) if ends_here else ordered[index])


def _coarse(image: Doubles) -> Doubles:
    """Reduces an environment image to 16 x 32 pixels, by means over solid angle.

    The means are over lookups on a grid finer than the image.
    """
    height = ENVIRONMENT_ROWS
    fine = -(-max(image.shape[0], image.shape[1] // 2, 4 * height) // height)
    looked_up = panorama_lookup(image, panorama_directions(height * fine, 2 * height * fine))
    angles = panorama_solid_angles(height * fine, 2 * height * fine).reshape(height, fine)
    columns = looked_up.reshape(height, fine, 2 * height, fine, 3).mean(axis=3)
    return np.einsum("hfwc,hf->hwc", columns, angles / angles.sum(axis=1, keepdims=True))
