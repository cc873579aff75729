"""Pairs of images that metrics compare: checked to have one shape and values in 0..1."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.constants.metrics import SSIM_WINDOW_PX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Flags, host_array

Image = npt.NDArray[np.float64]


def picture_pair(
    image: npt.ArrayLike, reference: npt.ArrayLike, region: npt.ArrayLike | None = None
) -> tuple[Image, Image, Flags]:
    """Both pictures as float64, shape (H, W, 3), in 0..1, equal outside of a region, and the region.

    Args:
        image: Display-referred values, 0..1, shape (H, W, 3); bytes are divided by 255.
        reference: The reference picture, in the same form.
        region: The pixels to compare, booleans of shape (H, W); None: all. Elsewhere the image becomes its reference.

    Raises:
        SceneError: A shape is not that of a picture, shapes differ, values are not finite or outside 0..1, or the
            region is empty.
    """
    tested, wanted = _unit_range("image", image), _unit_range("reference", reference)
    for name, pixels in (("image", tested), ("reference", wanted)):
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
            raise SceneError(f"{name} has shape {pixels.shape}, expected (H, W, 3)")
    _refuse_other_size(tested, wanted)
    if region is None:
        return tested, wanted, np.ones(tested.shape[:2], np.bool_)
    inside = _checked_region(region, tested.shape[:2])
    if not inside.any():
        raise SceneError("region is empty: no pixel is left to compare")
    return np.where(inside[..., None], tested, wanted), wanted, inside


def shadow_pair(shadow: npt.ArrayLike, reference: npt.ArrayLike, region: npt.ArrayLike | None) -> tuple[Image, Image]:
    """Both images of shadow strength as float64, shape (H, W), NaN outside of ``region``.

    Args:
        shadow: 0 (lit) to 1 (black), shape (H, W); bytes are divided by 255.
        reference: The reference, in the same form.
        region: The pixels to compare, booleans of shape (H, W); None: all.

    Raises:
        SceneError: A shape is not that of a mask, shapes differ, or values are not finite or outside 0..1.
    """
    pair = _unit_range("shadow", shadow), _unit_range("reference", reference)
    for name, pixels in zip(("shadow", "reference"), pair, strict=True):
        if pixels.ndim != 2 or pixels.size == 0:
            raise SceneError(f"{name} has shape {pixels.shape}, expected (H, W)")
    _refuse_other_size(*pair)
    if region is None:
        return pair
    inside = _checked_region(region, pair[0].shape)
    return np.where(inside, pair[0], np.nan), np.where(inside, pair[1], np.nan)


def check_window(metric: str, height: int, width: int) -> None:
    """Refuses pictures that are smaller than the window of SSIM.

    Raises:
        SceneError: They are.
    """
    if min(height, width) < SSIM_WINDOW_PX:
        window = f"{SSIM_WINDOW_PX} x {SSIM_WINDOW_PX}"
        raise SceneError(f"{metric} compares windows of {window} pixels, the images are {width} x {height}")


def region_means(values: Image, inside: Flags) -> Image:
    """The mean, for each channel, of windows whose middle is in a region.

    Args:
        values: Of windows, shape (H, W, 3).
        inside: The region, shape (H, W).

    Returns:
        Shape (3,).

    Raises:
        SceneError: There is none.
    """
    if not inside.any():
        raise SceneError("region has no pixel whose window lies inside the images")
    return values[inside].mean(axis=0)


def _checked_region(region: npt.ArrayLike, shape: tuple[int, ...]) -> Flags:
    inside = np.asarray(host_array(region))
    if inside.dtype != np.bool_ or inside.shape != shape:
        raise SceneError(f"region is {inside.dtype} of shape {inside.shape}, expected booleans of {shape}")
    return inside


def _unit_range(name: str, values: npt.ArrayLike) -> Image:
    """Values as float64, refused outside 0..1."""
    try:
        array = np.asarray(host_array(values))
    except ValueError:  # rows of different lengths
        raise SceneError(f"{name} is not an array of numbers") from None
    if array.dtype.kind not in "fiub":
        raise SceneError(f"{name} is not an array of numbers")
    pixels = array / 255.0 if array.dtype == np.uint8 else array.astype(np.float64)
    outside = np.count_nonzero(~((pixels >= 0.0) & (pixels <= 1.0)))
    if outside:
        raise SceneError(f"{name} has {outside:,} of {pixels.size:,} values outside 0..1, or not finite")
    return pixels


def _refuse_other_size(image: Image, reference: Image) -> None:
    if image.shape != reference.shape:
        (height, width), (other_height, other_width) = image.shape[:2], reference.shape[:2]
        raise SceneError(f"the image is {width} x {height}, its reference {other_width} x {other_height}")
