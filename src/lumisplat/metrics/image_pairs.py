"""Pairs of images that metrics compare: checked to have one shape and values in 0..1."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError

Image = npt.NDArray[np.float64]


def picture_pair(image: npt.ArrayLike, reference: npt.ArrayLike) -> tuple[Image, Image]:
    """Both pictures as float64, shape (H, W, 3), in 0..1.

    Args:
        image: Display-referred values, 0..1, shape (H, W, 3); bytes are divided by 255.
        reference: The reference picture, in the same form.

    Raises:
        SceneError: A shape is not that of a picture, shapes differ, or values are not finite or outside 0..1.
    """
    pair = _unit_range("image", image), _unit_range("reference", reference)
    for name, pixels in zip(("image", "reference"), pair, strict=True):
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.size == 0:
            raise SceneError(f"{name} has shape {pixels.shape}, expected (H, W, 3)")
    _refuse_other_size(*pair)
    return pair


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
    inside = np.asarray(region)
    if inside.dtype != np.bool_ or inside.shape != pair[0].shape:
        raise SceneError(f"region is {inside.dtype} of shape {inside.shape}, expected booleans of {pair[0].shape}")
    return np.where(inside, pair[0], np.nan), np.where(inside, pair[1], np.nan)


def _unit_range(name: str, values: npt.ArrayLike) -> Image:
    """Values as float64, refused outside 0..1."""
    try:
        array = np.asarray(values)
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
