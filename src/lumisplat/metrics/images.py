"""PSNR, SSIM, MS-SSIM and FLIP of a display-referred image against its reference.

MS-SSIM compares structure over several scales (Wang, Simoncelli and Bovik 2003). Images have one shape and values in
0..1.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import check_range, check_whole
from lumisplat.constants import SSIM_SIGMA_PX, SSIM_WINDOW_PX
from lumisplat.errors import MissingExtraError, SceneError
from lumisplat.math.arrays import Flags, host_array

FLIP_PIXELS_PER_DEGREE = 67.02064514160156
"""FLIP's default resolution, pixels per degree: a display 0.7 m wide, of 3840 pixels, seen from 0.7 m (Andersson et
al. 2020)."""


def import_extra(module: str, metric: str) -> Any:
    """Imports a module of the optional dependencies that a metric needs.

    Raises:
        MissingExtraError: The package is not installed.
    """
    try:
        return import_module(module)
    except ImportError:
        raise MissingExtraError(metric, "metrics") from None


def psnr(image: npt.ArrayLike, reference: npt.ArrayLike, *, region: npt.ArrayLike | None = None) -> float:
    """Returns the peak signal-to-noise ratio ``10 log10(1 / MSE)`` over all pixels and channels.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference image, of the same shape.
        region: The pixels to compare, booleans of shape (H, W); None: all.

    Returns:
        Decibels, at least 0, the higher the better; infinite if the images are equal.

    Raises:
        SceneError: The images differ in size or leave 0..1, or the region is empty.
    """
    tested, wanted, inside = image_pair(image, reference, region)
    error = float(np.mean((tested[inside] - wanted[inside]) ** 2))
    return float("inf") if error == 0.0 else -10.0 * np.log10(error).item()


def ssim(image: npt.ArrayLike, reference: npt.ArrayLike, *, region: npt.ArrayLike | None = None) -> float:
    """Returns the structural similarity (Wang et al. 2004), the mean over pixels and channels.

    Means, variances and covariance are weighted by a Gaussian of 1.5 pixels in windows of 11 x 11 pixels; K1 = 0.01 and
    K2 = 0.03 as in the paper. Only windows inside the image count, so the outermost 5 pixels have no value;
    implementations that pad the image differ there. Computed by scikit-image.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3), at least 11 pixels in both directions.
        reference: The reference image, of the same shape.
        region: The pixels to compare, booleans of shape (H, W); None: all. The mean is over windows whose centre is in
            the region, with the image set to its reference outside of the region.

    Returns:
        -1..1, the higher the better; 1 if the images are equal.

    Raises:
        SceneError: The images differ in size, leave 0..1 or are smaller than the window, or no window has its centre in
            the region.
        MissingExtraError: scikit-image is not installed.
    """
    tested, wanted, inside = image_pair(image, reference, region)
    check_window("ssim", tested.shape[0], tested.shape[1])
    similarity = import_extra("skimage.metrics", "ssim").structural_similarity
    options = {"data_range": 1.0, "channel_axis": 2, "gaussian_weights": True, "sigma": SSIM_SIGMA_PX}
    values = np.asarray(similarity(tested, wanted, full=True, use_sample_covariance=False, **options)[1])
    edge = SSIM_WINDOW_PX // 2
    return float(region_means(values[edge:-edge, edge:-edge], inside[edge:-edge, edge:-edge]).mean())


def flip(
    image: npt.ArrayLike,
    reference: npt.ArrayLike,
    *,
    pixels_per_degree: float = FLIP_PIXELS_PER_DEGREE,
    region: npt.ArrayLike | None = None,
) -> float:
    """Returns LDR-FLIP (Andersson et al. 2020), the mean visible difference when flipping between two images.

    Computed by NVIDIA's implementation.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference image, of the same shape.
        pixels_per_degree: Resolution of the display, pixels per degree of visual angle, 1 to 1000. FLIP's default is
            a 4K screen, 0.7 m wide, seen from 0.7 m.
        region: The pixels to compare, booleans of shape (H, W); None: all. The image is set to its reference elsewhere.

    Returns:
        0..1, the lower the better; 0 if the images are equal.

    Raises:
        ConfigError: ``pixels_per_degree`` is out of range.
        SceneError: The images differ in size or leave 0..1, or the region is empty.
        MissingExtraError: flip-evaluator is not installed.
    """
    tested, wanted, inside = image_pair(image, reference, region)
    check_range("pixels_per_degree", pixels_per_degree, 1, 1000)
    values = import_extra("flip_evaluator", "flip").evaluate(
        np.ascontiguousarray(wanted, np.float32),
        np.ascontiguousarray(tested, np.float32),
        "LDR",
        applyMagma=False,
        parameters={"ppd": float(pixels_per_degree)},
    )[0]
    return float(np.asarray(values).reshape(inside.shape)[inside].mean(dtype=np.float64))


_WEIGHTS = np.array((0.0448, 0.2856, 0.3001, 0.2363, 0.1333))
"""Exponents of the five scales of MS-SSIM, finest first (Wang et al. 2003, section 3.2)."""
_C1, _C2 = 0.01**2, 0.03**2


def ms_ssim(
    image: npt.ArrayLike, reference: npt.ArrayLike, *, scales: int = len(_WEIGHTS), region: npt.ArrayLike | None = None
) -> float:
    """Returns the multi-scale structural similarity (Wang et al. 2003): a product over scales, averaged over channels.

    Each scale has half the size of the previous one, by means over 2 x 2 pixels; an odd last row or column is repeated.
    The factor of a scale is a mean over windows, to the power of the scale's weight: 0.0448, 0.2856, 0.3001, 0.2363,
    0.1333. The mean is that of contrast times structure and, at the coarsest scale, times luminance. A negative mean
    counts as 0. Windows are as in `ssim`.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3), at least ``10 * 2 ** (scales - 1) + 1`` pixels in
            both directions: 161 with 5 scales.
        reference: The reference image, of the same shape.
        scales: Number of scales, 1 to 5. With fewer than 5, the remaining weights are divided by their sum; such values
            are only comparable to others with as many scales. One scale is `ssim` itself.
        region: The pixels to compare, booleans of shape (H, W); None: all. Means are over windows whose centre is in
            the region; at coarser scales, over windows whose central pixel covers a part of the region. The image is
            set to its reference outside of the region.

    Returns:
        0..1, the higher the better; 1 if the images are equal.

    Raises:
        ConfigError: ``scales`` is out of range.
        SceneError: The images differ in size, leave 0..1 or are too small for so many scales, or no window has its
            centre in the region.
    """
    check_whole("scales", scales, 1, len(_WEIGHTS))
    tested, wanted, inside = image_pair(image, reference, region)
    height, width = inside.shape
    check_window("ms_ssim", height, width)
    possible = ms_ssim_scales(height, width)
    if possible < scales:
        needed = 10 * 2 ** (scales - 1) + 1
        raise SceneError(
            f"ms_ssim with {scales} scales compares images of {needed} x {needed} pixels or more, these are "
            f"{width} x {height}: use scales={possible}"
        )
    weights = _WEIGHTS if scales == len(_WEIGHTS) else _WEIGHTS[:scales] / _WEIGHTS[:scales].sum()
    edge = SSIM_WINDOW_PX // 2
    product = np.ones(3)
    for scale, weight in enumerate(weights):
        luminance, structure = _similarity(tested, wanted)
        values = structure if scale < scales - 1 else luminance * structure
        product *= np.maximum(region_means(values, inside[edge:-edge, edge:-edge]), 0.0) ** weight
        tested, wanted = _halved(tested), _halved(wanted)
        inside = _halved(inside[..., None].astype(np.float64))[..., 0] > 0.0
    return float(product.mean())


def ms_ssim_scales(height: int, width: int) -> int:
    """Returns the largest number of scales that `ms_ssim` can use for images of a given size, 0 to 5."""
    return sum(min(height, width) > 10 * 2**scale for scale in range(len(_WEIGHTS)))


def _similarity(tested: Image, wanted: Image) -> tuple[Image, Image]:
    """Returns two maps of SSIM over the windows of 11 x 11 pixels: luminance, and contrast times structure.

    The equations are 1 to 6 of Wang et al. 2003.
    """
    mean_x, mean_y = _blurred(tested), _blurred(wanted)
    variance_x = _blurred(tested * tested) - mean_x * mean_x
    variance_y = _blurred(wanted * wanted) - mean_y * mean_y
    covariance = _blurred(tested * wanted) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x * mean_x + mean_y * mean_y + _C1)
    return luminance, (2.0 * covariance + _C2) / (variance_x + variance_y + _C2)


def _blurred(image: Image) -> Image:
    """Returns Gaussian-weighted means of an image over all 11 x 11 windows that are inside of it.

    The result is 10 pixels shorter than the image in both directions.
    """
    offsets = np.arange(SSIM_WINDOW_PX) - SSIM_WINDOW_PX // 2
    bell = np.exp(-0.5 * (offsets / SSIM_SIGMA_PX) ** 2)
    bell /= bell.sum()
    rows, columns = (size - SSIM_WINDOW_PX + 1 for size in image.shape[:2])
    down = np.sum([weight * image[k : k + rows] for k, weight in enumerate(bell)], axis=0)
    return np.sum([weight * down[:, k : k + columns] for k, weight in enumerate(bell)], axis=0)


def _halved(image: Image) -> Image:
    """Halves the size of an image by means over 2 x 2 pixels; an odd last row or column is repeated."""
    even = np.pad(image, [(0, size % 2) for size in image.shape[:2]] + [(0, 0)], mode="edge")
    return 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])


Image = npt.NDArray[np.float64]


def image_pair(
    image: npt.ArrayLike, reference: npt.ArrayLike, region: npt.ArrayLike | None = None
) -> tuple[Image, Image, Flags]:
    """Validates an image and its reference; returns both as float64, shape (H, W, 3), and the region.

    Args:
        image: Display-referred values, 0..1, shape (H, W, 3); bytes are divided by 255.
        reference: The reference image, in the same form.
        region: The pixels to compare, booleans of shape (H, W); None: all. The image is set to its reference elsewhere.

    Raises:
        SceneError: A shape is not (H, W, 3), shapes differ, values are not finite or outside 0..1, or the region is
            empty.
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
    """Validates two images of shadow strength; returns both as float64, shape (H, W), NaN outside of ``region``.

    Args:
        shadow: Shadow strength, 0 (lit) to 1 (black), shape (H, W); bytes are divided by 255.
        reference: The reference image, in the same form.
        region: The pixels to compare, booleans of shape (H, W); None: all.

    Raises:
        SceneError: A shape is not (H, W), shapes differ, or values are not finite or outside 0..1.
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
    """Raises a SceneError unless the images are at least as large as a window of SSIM.

    Raises:
        SceneError: The images are smaller; the message names ``metric``.
    """
    if min(height, width) < SSIM_WINDOW_PX:
        window = f"{SSIM_WINDOW_PX} x {SSIM_WINDOW_PX}"
        raise SceneError(
            f"{metric} compares windows of {window} pixels, the images are {width} x {height}: use larger images, "
            "or psnr"
        )


def region_means(values: Image, inside: Flags) -> Image:
    """Returns the mean of each channel over the SSIM windows whose centre is in a region, shape (3,).

    Args:
        values: One value for each channel of each window, at the window's centre, shape (H, W, 3).
        inside: True for centres in the region, shape (H, W).

    Raises:
        SceneError: No window has its centre in the region.
    """
    if not inside.any():
        window = f"{SSIM_WINDOW_PX} x {SSIM_WINDOW_PX}"
        raise SceneError(
            f"no window of {window} pixels inside the images has its centre in region: enlarge region, or use psnr"
        )
    return values[inside].mean(axis=0)


def _checked_region(region: npt.ArrayLike, shape: tuple[int, ...]) -> Flags:
    inside = np.asarray(host_array(region))
    if inside.dtype != np.bool_ or inside.shape != shape:
        raise SceneError(f"region is {inside.dtype} of shape {inside.shape}, expected booleans of {shape}")
    return inside


def _unit_range(name: str, values: npt.ArrayLike) -> Image:
    """Returns ``values`` as float64, bytes divided by 255; raises a SceneError if any is outside 0..1."""
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
