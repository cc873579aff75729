"""PSNR, SSIM and FLIP of a display-referred picture against its reference."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_range
from lumisplat.constants.metrics import FLIP_PIXELS_PER_DEGREE, SSIM_SIGMA_PX, SSIM_WINDOW_PX
from lumisplat.metrics.extras import import_extra
from lumisplat.metrics.image_pairs import check_window, picture_pair, region_means


def psnr(image: npt.ArrayLike, reference: npt.ArrayLike, *, region: npt.ArrayLike | None = None) -> float:
    """Peak signal-to-noise ratio: ``10 log10(1 / MSE)`` over all pixels and channels.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference, of the same shape.
        region: The pixels to compare, booleans of shape (H, W); None: all.

    Returns:
        Decibels, at least 0, the higher the better; infinite if both are equal.

    Raises:
        SceneError: These are not two pictures of one size in 0..1, or the region is empty.
    """
    tested, wanted, inside = picture_pair(image, reference, region)
    error = float(np.mean((tested[inside] - wanted[inside]) ** 2))
    return float("inf") if error == 0.0 else -10.0 * np.log10(error).item()


def ssim(image: npt.ArrayLike, reference: npt.ArrayLike, *, region: npt.ArrayLike | None = None) -> float:
    """Structural similarity (Wang et al. 2004), the mean over pixels and channels.

    Means, variances and covariance are weighted by a Gaussian of 1.5 pixels in windows of 11 x 11 pixels; K1 = 0.01 and
    K2 = 0.03 as in the paper. Only windows that lie fully inside the picture count, so that the outermost 5 pixels have
    no value of their own; implementations that pad the picture differ there. Computed by scikit-image.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3), at least 11 pixels in both directions.
        reference: The reference, of the same shape.
        region: The pixels to compare, booleans of shape (H, W); None: all. The mean is over windows whose middle is in
            it, for which the image elsewhere is that of the reference.

    Returns:
        -1..1, the higher the better; 1 if both are equal.

    Raises:
        SceneError: These are not two pictures of one size in 0..1, they are smaller than the window, or no window has
            its middle in the region.
        MissingExtraError: scikit-image is not installed.
    """
    tested, wanted, inside = picture_pair(image, reference, region)
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
    """LDR-FLIP (Andersson et al. 2020), the mean over pixels: the visible difference when flipping between both.

    Computed by NVIDIA's implementation.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3).
        reference: The reference, of the same shape.
        pixels_per_degree: Resolution of the display, pixels per degree of visual angle, 1 to 1000. FLIP's default is
            a 4K screen, 0.7 m wide, seen from 0.7 m.
        region: The pixels to compare, booleans of shape (H, W); None: all. Elsewhere the image is taken to be its
            reference.

    Returns:
        0..1, the lower the better; 0 if both are equal.

    Raises:
        ConfigError: ``pixels_per_degree`` is out of range.
        SceneError: These are not two pictures of one size in 0..1, or the region is empty.
        MissingExtraError: flip-evaluator is not installed.
    """
    tested, wanted, inside = picture_pair(image, reference, region)
    check_range("pixels_per_degree", pixels_per_degree, 1, 1000)
    values = import_extra("flip_evaluator", "flip").evaluate(
        np.ascontiguousarray(wanted, np.float32),
        np.ascontiguousarray(tested, np.float32),
        "LDR",
        applyMagma=False,
        parameters={"ppd": float(pixels_per_degree)},
    )[0]
    return float(np.asarray(values).reshape(inside.shape)[inside].mean(dtype=np.float64))
