"""Structural similarity over several scales (Wang, Simoncelli and Bovik 2003)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_whole
from lumisplat.constants.metrics import SSIM_SIGMA_PX, SSIM_WINDOW_PX
from lumisplat.errors import SceneError
from lumisplat.metrics.image_pairs import Image, check_window, picture_pair, region_means

_WEIGHTS = np.array((0.0448, 0.2856, 0.3001, 0.2363, 0.1333))
"""Exponents of the scales, the finest first: section 3.2 of the paper."""
_C1, _C2 = 0.01**2, 0.03**2


def ms_ssim(
    image: npt.ArrayLike, reference: npt.ArrayLike, *, scales: int = len(_WEIGHTS), region: npt.ArrayLike | None = None
) -> float:
    """Structural similarity over scales (Wang et al. 2003): the mean over channels of a product over scales.

    Each scale has half the size of the one before, by means over 2 x 2 pixels; of an odd number of rows or columns, the
    last is repeated. Its factor is the mean of contrast times structure, of the coarsest also times luminance, to the
    power of its weight: 0.0448, 0.2856, 0.3001, 0.2363, 0.1333. A mean below 0 counts as 0. Windows are as in `ssim`.

    Args:
        image: Display-referred sRGB, 0..1 or bytes, shape (H, W, 3), with 5 scales at least 161 pixels in both
            directions, else ``10 * 2 ** (scales - 1) + 1``.
        reference: The reference, of the same shape.
        scales: How many there are, 1 to 5. With fewer than 5, the weights of those that are left are divided by their
            sum: such values compare with others of as many scales only. One is `ssim` itself.
        region: The pixels to compare, booleans of shape (H, W); None: all. Means are over windows whose middle is in
            it, in coarser scales over those whose middle covers some of it, for which the image elsewhere is that of
            the reference.

    Returns:
        0..1, the higher the better; 1 if both are equal.

    Raises:
        ConfigError: ``scales`` is out of range.
        SceneError: These are not two pictures of one size in 0..1, they are too small for so many scales, or no window
            has its middle in the region.
    """
    check_whole("scales", scales, 1, len(_WEIGHTS))
    tested, wanted, inside = picture_pair(image, reference, region)
    height, width = inside.shape
    check_window("ms_ssim", height, width)
    possible = ms_ssim_scales(height, width)
    if possible < scales:
        needed = 10 * 2 ** (scales - 1) + 1
        raise SceneError(
            f"ms_ssim with {scales} scales compares images of {needed} x {needed} pixels or more, these are "
            f"{width} x {height}: scales={possible} suits them"
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
    """How many scales pictures of a size have in `ms_ssim`, 0 to 5."""
    return sum(min(height, width) > 10 * 2**scale for scale in range(len(_WEIGHTS)))


def _similarity(tested: Image, wanted: Image) -> tuple[Image, Image]:
    """Luminance, and contrast times structure, of each window that lies inside; equations 1 to 6 of the paper."""
    mean_x, mean_y = _blurred(tested), _blurred(wanted)
    variance_x = _blurred(tested * tested) - mean_x * mean_x
    variance_y = _blurred(wanted * wanted) - mean_y * mean_y
    covariance = _blurred(tested * wanted) - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x * mean_x + mean_y * mean_y + _C1)
    return luminance, (2.0 * covariance + _C2) / (variance_x + variance_y + _C2)


def _blurred(image: Image) -> Image:
    """Means over windows, weighted by a Gaussian; shorter by a window less a pixel in both directions."""
    offsets = np.arange(SSIM_WINDOW_PX) - SSIM_WINDOW_PX // 2
    bell = np.exp(-0.5 * (offsets / SSIM_SIGMA_PX) ** 2)
    bell /= bell.sum()
    rows, columns = (size - SSIM_WINDOW_PX + 1 for size in image.shape[:2])
    down = np.sum([weight * image[k : k + rows] for k, weight in enumerate(bell)], axis=0)
    return np.sum([weight * down[:, k : k + columns] for k, weight in enumerate(bell)], axis=0)


def _halved(image: Image) -> Image:
    """Means over 2 x 2 pixels; an odd last row or column is repeated."""
    even = np.pad(image, [(0, size % 2) for size in image.shape[:2]] + [(0, 0)], mode="edge")
    return 0.25 * (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2])
