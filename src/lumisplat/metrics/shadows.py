"""Shadow metrics SAE, SM-IoU and BF of shadow strength against a reference (docs/method/relighting.md#metrics).

Shadow strength S is 0 where all light arrives and 1 where none does. A pixel is in shadow where S > tau.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import check_range
from lumisplat.metrics.images import Image, shadow_pair

SHADOW_MASK_THRESHOLD = 0.1
"""Shadow strength tau above which a pixel is in shadow (Mir et al. 2026, section 4.2)."""

BOUNDARY_TOLERANCE_PX = 2.0
"""Largest distance between two shadow boundaries that agree, pixels (Mir et al. 2026, section 4.2, table 3)."""

_Mask = npt.NDArray[np.bool_]


def sae(
    shadow: npt.ArrayLike,
    reference: npt.ArrayLike,
    *,
    threshold: float = SHADOW_MASK_THRESHOLD,
    region: npt.ArrayLike | None = None,
) -> float:
    """Returns the shadow attenuation error: the mean of ``|S - S_ref|`` over the pixels with ``S_ref > threshold``.

    Shadow outside of the reference's shadow does not count; `sm_iou` measures it. Source: Mir et al. 2026, section 4.2.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: Shadow strength S_ref of the reference, of the same shape.
        threshold: Shadow strength tau above which a pixel is in shadow, 0..1.
        region: The pixels to compare, booleans of the same shape; None: all.

    Returns:
        0..1, the lower the better. NaN if the reference has no shadow.

    Raises:
        ConfigError: ``threshold`` is out of range.
        SceneError: The images differ in size or leave 0..1.
    """
    tested, wanted = _checked(shadow, reference, threshold, region)
    inside = wanted > threshold
    return float(np.abs(tested - wanted)[inside].mean()) if inside.any() else math.nan


def sm_iou(
    shadow: npt.ArrayLike,
    reference: npt.ArrayLike,
    *,
    threshold: float = SHADOW_MASK_THRESHOLD,
    region: npt.ArrayLike | None = None,
) -> float:
    """Returns the shadow matte intersection over union: pixels in shadow in both images over those in either.

    Source: Mir et al. 2026, section 4.2.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: Shadow strength of the reference, of the same shape.
        threshold: Shadow strength tau above which a pixel is in shadow, 0..1.
        region: The pixels to compare, booleans of the same shape; None: all.

    Returns:
        0..1, the higher the better; 1 if neither image has a shadow.

    Raises:
        ConfigError: ``threshold`` is out of range.
        SceneError: The images differ in size or leave 0..1.
    """
    tested, wanted = (image > threshold for image in _checked(shadow, reference, threshold, region))
    either = np.count_nonzero(tested | wanted)
    return float(np.count_nonzero(tested & wanted) / either) if either else 1.0


def boundary_f(
    shadow: npt.ArrayLike,
    reference: npt.ArrayLike,
    *,
    tolerance: float = BOUNDARY_TOLERANCE_PX,
    threshold: float = SHADOW_MASK_THRESHOLD,
    region: npt.ArrayLike | None = None,
) -> float:
    """Returns the boundary F-measure (BF): the agreement of the outlines of two shadows.

    A pixel in shadow is on the boundary if one of its four neighbours is lit; the border of the image or of the region
    is no boundary. P is the fraction of the image's boundary pixels that have a boundary pixel of the reference within
    ``tolerance`` (between pixel centres). R is the fraction of the reference's boundary pixels that have one of the
    image within it. ``BF = 2 P R / (P + R)``. Source: Mir et al. 2026, section 4.2; the definition is that of Perazzi
    et al. (DAVIS, 2016), with a tolerance in pixels.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: Shadow strength of the reference, of the same shape.
        tolerance: Largest distance between boundary pixels that agree, pixels, 0..100.
        threshold: Shadow strength tau above which a pixel is in shadow, 0..1.
        region: The pixels to compare, booleans of the same shape; None: all.

    Returns:
        0..1, the higher the better. 1 if neither image has a boundary, 0 if only one has.

    Raises:
        ConfigError: ``tolerance`` or ``threshold`` is out of range.
        SceneError: The images differ in size or leave 0..1.
    """
    check_range("tolerance", tolerance, 0, 100)
    tested, wanted = (_boundary(image, threshold) for image in _checked(shadow, reference, threshold, region))
    if not tested.any() or not wanted.any():
        return float(tested.any() == wanted.any())
    precision = np.count_nonzero(tested & _dilate(wanted, tolerance)) / np.count_nonzero(tested)
    recall = np.count_nonzero(wanted & _dilate(tested, tolerance)) / np.count_nonzero(wanted)
    return float(2.0 * precision * recall / (precision + recall)) if precision + recall else 0.0


def _checked(
    shadow: npt.ArrayLike, reference: npt.ArrayLike, threshold: float, region: npt.ArrayLike | None
) -> tuple[Image, Image]:
    check_range("threshold", threshold, 0, 1)
    return shadow_pair(shadow, reference, region)


def _boundary(image: Image, threshold: float) -> _Mask:
    """Returns which pixels are in shadow and have a lit neighbour; NaN is neither lit nor in shadow."""
    lit = np.pad(image <= threshold, 1)
    beside = lit[:-2, 1:-1] | lit[2:, 1:-1] | lit[1:-1, :-2] | lit[1:-1, 2:]
    return (image > threshold) & beside


def _dilate(mask: _Mask, radius: float) -> _Mask:
    """Returns which pixels lie within ``radius`` pixels of a True pixel of ``mask``."""
    reach = math.floor(radius)
    height, width = mask.shape
    padded = np.pad(mask, reach)
    dilated = np.zeros_like(mask)
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if down * down + right * right <= radius * radius:
                dilated |= padded[reach + down : reach + down + height, reach + right : reach + right + width]
    return dilated
