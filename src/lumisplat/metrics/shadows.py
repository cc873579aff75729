"""How near images of shadow strength are to a reference: SAE, SM-IoU and BF (docs/method/relighting.md#metrics).

Shadow strength S is 0 where light arrives and 1 where none does. A pixel is in shadow where S > tau.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_range
from lumisplat.constants import BOUNDARY_TOLERANCE_PX, SHADOW_MASK_THRESHOLD
from lumisplat.metrics.arguments import Image, same_masks

_Mask = npt.NDArray[np.bool_]


def sae(
    shadow: npt.ArrayLike,
    reference: npt.ArrayLike,
    *,
    threshold: float = SHADOW_MASK_THRESHOLD,
    region: npt.ArrayLike | None = None,
) -> float:
    """Shadow attenuation error: the mean of ``|S - S_ref|`` over the pixels with ``S_ref > threshold``.

    Shadow outside of the reference's does not count here: `sm_iou` sees it. Source: Mir et al. 2026, section 4.2.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: That of the reference, of the same shape.
        threshold: tau, 0..1.
        region: Booleans of the same shape, where to look; None: everywhere.

    Returns:
        0..1, the lower the better. NaN where the reference has no shadow: there is nothing to average.

    Raises:
        ConfigError: ``threshold`` is out of range.
        SceneError: These are no two images of one size and range.
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
    """Shadow matte intersection over union: pixels in shadow in both images, over those in shadow in one at least.

    Source: Mir et al. 2026, section 4.2.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: That of the reference, of the same shape.
        threshold: tau, 0..1.
        region: Booleans of the same shape, where to look; None: everywhere.

    Returns:
        0..1, the higher the better; 1 where there is no shadow in either.

    Raises:
        ConfigError: ``threshold`` is out of range.
        SceneError: These are no two images of one size and range.
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
    """Boundary F-measure (BF): how well the outlines of two shadows agree.

    A pixel in shadow is on the boundary if one of its four neighbours is lit; the border of the image or of the region
    is no boundary. With P the share of the boundary's pixels that have a pixel of the reference's boundary within
    ``tolerance`` (between pixel centres), and R the share of the reference's that have one of the boundary's,
    ``BF = 2 P R / (P + R)``. Source: Mir et al. 2026, section 4.2; the definition is that of Perazzi et al. (DAVIS,
    2016), with a tolerance in pixels.

    Args:
        shadow: Shadow strength S, 0..1 or bytes, shape (H, W).
        reference: That of the reference, of the same shape.
        tolerance: Pixels, 0..100.
        threshold: tau, 0..1.
        region: Booleans of the same shape, where to look; None: everywhere.

    Returns:
        0..1, the higher the better. 1 where neither has a boundary, 0 where one has none.

    Raises:
        ConfigError: ``tolerance`` or ``threshold`` is out of range.
        SceneError: These are no two images of one size and range.
    """
    check_range("tolerance", tolerance, 0, 100)
    tested, wanted = (_boundary(image, threshold) for image in _checked(shadow, reference, threshold, region))
    if not tested.any() or not wanted.any():
        return float(tested.any() == wanted.any())
    precision = np.count_nonzero(tested & _grown(wanted, tolerance)) / np.count_nonzero(tested)
    recall = np.count_nonzero(wanted & _grown(tested, tolerance)) / np.count_nonzero(wanted)
    return float(2.0 * precision * recall / (precision + recall)) if precision + recall else 0.0


def _checked(
    shadow: npt.ArrayLike, reference: npt.ArrayLike, threshold: float, region: npt.ArrayLike | None
) -> tuple[Image, Image]:
    check_range("threshold", threshold, 0, 1)
    return same_masks(shadow, reference, region)


def _boundary(image: Image, threshold: float) -> _Mask:
    """Pixels in shadow with a lit neighbour; NaN is neither."""
    lit = np.pad(image <= threshold, 1)
    beside = lit[:-2, 1:-1] | lit[2:, 1:-1] | lit[1:-1, :-2] | lit[1:-1, 2:]
    return (image > threshold) & beside


def _grown(mask: _Mask, radius: float) -> _Mask:
    """Pixels within ``radius`` of one of ``mask``."""
    reach = math.floor(radius)
    height, width = mask.shape
    padded = np.pad(mask, reach)
    grown_capacity = np.zeros_like(mask)
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            if down * down + right * right <= radius * radius:
                grown_capacity |= padded[reach + down : reach + down + height, reach + right : reach + right + width]
    return grown_capacity
