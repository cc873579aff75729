"""PSNR, SSIM and FLIP of a display-referred picture against its reference."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_range
from lumisplat.constants import FLIP_PIXELS_PER_DEGREE, SSIM_SIGMA_PX, SSIM_WINDOW_PX
from lumisplat.errors import SceneError
from lumisplat.metrics.extras import import_extra
from lumisplat.metrics.image_pairs import picture_pair


def psnr(image: npt.ArrayLike, reference: npt.ArrayLike) -> float:
    """Peak signal-to-noise ratio: ``10 log10(1 / MSE)`` over all pixels and channels.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference, of the same shape.

    Returns:
        Decibels, at least 0, the higher the better; infinite if both are equal.

    Raises:
        SceneError: These are not two pictures of one size in 0..1.
    """
    tested, wanted = picture_pair(image, reference)
    error = float(np.mean((tested - wanted) ** 2))
    return float("inf") if error == 0.0 else -10.0 * np.log10(error).item()


def ssim(image: npt.ArrayLike, reference: npt.ArrayLike) -> float:
    """Structural similarity (Wang et al. 2004), the mean over pixels and channels.

    Means, variances and covariance are weighted by a Gaussian of 1.5 pixels in windows of 11 x 11 pixels that lie fully
    inside the picture; K1 = 0.01 and K2 = 0.03 as in the paper. Computed by scikit-image.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3), at least 11 pixels in both directions.
        reference: The reference, of the same shape.

    Returns:
        -1..1, the higher the better; 1 if both are equal.

    Raises:
        SceneError: These are not two pictures of one size in 0..1, or they are smaller than the window.
        MissingExtraError: scikit-image is not installed.
    """
    tested, wanted = picture_pair(image, reference)
    if min(tested.shape[:2]) < SSIM_WINDOW_PX:
        height, width = tested.shape[:2]
        raise SceneError(
            f"ssim compares windows of {SSIM_WINDOW_PX} x {SSIM_WINDOW_PX} pixels, the images are {width} x {height}"
        )
    similarity = import_extra("skimage.metrics", "ssim").structural_similarity(
        tested,
        wanted,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=SSIM_SIGMA_PX,
        use_sample_covariance=False,
    )
    return float(np.asarray(similarity))


def flip(image: npt.ArrayLike, reference: npt.ArrayLike, *, pixels_per_degree: float = FLIP_PIXELS_PER_DEGREE) -> float:
    """LDR-FLIP (Andersson et al. 2020), the mean over pixels: the visible difference when flipping between both.

    Computed by NVIDIA's implementation.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference, of the same shape.
        pixels_per_degree: Resolution of the display, pixels per degree of visual angle, 1 to 1000. FLIP's default is
            a 4K screen, 0.7 m wide, seen from 0.7 m.

    Returns:
        0..1, the lower the better; 0 if both are equal.

    Raises:
        ConfigError: ``pixels_per_degree`` is out of range.
        SceneError: These are not two pictures of one size in 0..1.
        MissingExtraError: flip-evaluator is not installed.
    """
    tested, wanted = picture_pair(image, reference)
    check_range("pixels_per_degree", pixels_per_degree, 1, 1000)
    mean = import_extra("flip_evaluator", "flip").evaluate(
        np.ascontiguousarray(wanted, np.float32),
        np.ascontiguousarray(tested, np.float32),
        "LDR",
        applyMagma=False,
        parameters={"ppd": float(pixels_per_degree)},
    )[1]
    return float(mean)
