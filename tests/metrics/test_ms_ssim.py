"""MS-SSIM, and pictures that are compared in a region: closed forms, and a second implementation."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import convolve2d

import lumisplat as ls

WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def picture(seed: int, shape: tuple[int, int] = (176, 192)) -> np.ndarray:
    """A picture of smooth shapes and noise, 0.05 to 0.95."""
    rng = np.random.default_rng(seed)
    y, x = np.arange(shape[0])[:, None, None], np.arange(shape[1])[:, None]
    waves = np.sin(x * rng.uniform(0.02, 0.3, 3) + y * rng.uniform(0.02, 0.3, 3) + rng.uniform(0.0, 6.0, 3))
    return np.clip(0.5 + 0.3 * waves + 0.05 * rng.normal(size=(*shape, 3)), 0.05, 0.95)


def noisy(image: np.ndarray, size: float) -> np.ndarray:
    """The picture with noise."""
    return np.clip(image + size * np.random.default_rng(99).normal(size=image.shape), 0.0, 1.0)


def ms_ssim_by_convolution(image: np.ndarray, reference: np.ndarray, weights: tuple[float, ...] = WEIGHTS) -> float:
    """Wang et al. 2003 by full two-dimensional windows, scale by scale; odd last rows and columns are repeated."""
    offsets = np.arange(-5.0, 6.0)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / 4.5)
    window /= window.sum()
    of_channels = []
    for channel in range(3):
        x, y = image[..., channel], reference[..., channel]
        value = 1.0
        for scale, weight in enumerate(weights):
            mean_x, mean_y, xx, yy, xy = (
                convolve2d(term, window, mode="valid") for term in (x, y, x * x, y * y, x * y)
            )
            structure = (2 * (xy - mean_x * mean_y) + 9e-4) / (xx - mean_x**2 + yy - mean_y**2 + 9e-4)
            luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
            value *= (structure * luminance if scale == len(weights) - 1 else structure).mean() ** weight
            x, y = (np.pad(plane, [(0, size % 2) for size in plane.shape], mode="edge") for plane in (x, y))
            x, y = (plane.reshape(plane.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3)) for plane in (x, y))
        of_channels.append(value)
    return float(np.mean(of_channels))


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.4])
def test_ms_ssim_is_that_of_the_paper(noise):
    """The product over five scales, each filtered by a second implementation, whose values are far from one another."""
    reference = picture(1)
    image = noisy(reference, noise)
    expected = ms_ssim_by_convolution(image, reference)
    assert ls.ms_ssim(image, reference) == pytest.approx(expected, abs=1e-12)
    assert 0.3 < expected < 0.9999


def test_ms_ssim_of_flat_pictures():
    """Without contrast, all that counts is the luminance of the coarsest scale: (0.4801 / 0.5201) ** 0.1333."""
    dark, light = np.full((161, 170, 3), 0.4), np.full((161, 170, 3), 0.6)
    assert ls.ms_ssim(dark, light) == pytest.approx((0.4801 / 0.5201) ** 0.1333, abs=1e-9)
    last = 0.2363 / (0.0448 + 0.2856 + 0.3001 + 0.2363)
    assert ls.ms_ssim(dark, light, scales=4) == pytest.approx((0.4801 / 0.5201) ** last, abs=1e-9)


def test_one_scale_is_ssim():
    """One scale has weight 1: SSIM, which scikit-image computes."""
    reference = picture(2, (40, 33))
    image = noisy(reference, 0.1)
    assert ls.ms_ssim(image, reference, scales=1) == pytest.approx(ls.ssim(image, reference), abs=1e-9)


def test_what_is_opposite_is_worth_nothing():
    """A negative picture has a negative mean of structure, which counts as 0."""
    reference = picture(3)
    assert ls.ms_ssim(1.0 - reference, reference) == 0.0
    assert ls.ms_ssim(reference, reference) == pytest.approx(1.0, abs=1e-12)


def test_sizes_need_not_be_powers_of_two():
    """Of an odd size, the last row and column are repeated; the weights of two scales sum to 1."""
    reference = picture(4, (45, 47))
    image = noisy(reference, 0.1)
    weights = (0.0448 / (0.0448 + 0.2856), 0.2856 / (0.0448 + 0.2856))
    expected = ms_ssim_by_convolution(image, reference, weights)
    assert ls.ms_ssim(image, reference, scales=2) == pytest.approx(expected, abs=1e-12)


def test_small_pictures_have_fewer_scales():
    """161 pixels are enough for five scales, 160 for four; what is too small is refused by name, never in silence."""
    sizes = {161: 5, 160: 4, 81: 4, 80: 3, 21: 2, 20: 1, 11: 1, 10: 0}
    assert {size: ls.ms_ssim_scales(size, 500) for size in sizes} == sizes
    assert {size: ls.ms_ssim_scales(500, size) for size in sizes} == sizes
    for size, scales in sizes.items():
        flat = np.full((size, size + 3, 3), 0.5)
        if scales:
            assert ls.ms_ssim(flat, flat, scales=scales) == pytest.approx(1.0)
        if 0 < scales < 5:
            with pytest.raises(ls.SceneError, match=f"these are {size + 3} x {size}: scales={scales} suits them"):
                ls.ms_ssim(flat, flat, scales=scales + 1)
    with pytest.raises(ls.SceneError, match="ms_ssim compares windows of 11 x 11 pixels, the images are 12 x 10"):
        ls.ms_ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)), scales=1)
    for scales in (0, 6, 2.5):
        with pytest.raises(ls.ConfigError, match="scales is"):
            ls.ms_ssim(picture(1), picture(1), scales=cast(Any, scales))


METRICS = (ls.psnr, ls.ssim, ls.ms_ssim, ls.flip)


@pytest.mark.parametrize("metric", METRICS)
def test_what_is_outside_of_a_region_does_not_count(metric):
    """Whatever the image holds there; and within it, errors count."""
    reference = picture(5)
    image = noisy(reference, 0.05)
    region = np.zeros(reference.shape[:2], bool)
    region[30:120, 40:150] = True
    value = metric(image, reference, region=region)
    assert metric(np.where(region[..., None], image, 1.0), reference, region=region) == pytest.approx(value, abs=1e-9)
    worse = np.where(region[..., None], noisy(reference, 0.2), image)
    better = metric is ls.flip
    assert (metric(worse, reference, region=region) > value) == better
    assert metric(image, reference, region=np.ones_like(region)) == pytest.approx(metric(image, reference), abs=1e-9)
    assert metric(np.where(region[..., None], reference, image), reference, region=region) == pytest.approx(
        {ls.psnr: np.inf, ls.flip: 0.0}.get(metric, 1.0), abs=1e-9
    )


def test_psnr_of_a_region_is_the_error_there():
    """Off by 0.1 in a quarter of the picture: 20 dB in that quarter, 6.02 dB more all over."""
    grey = np.full((32, 32, 3), 0.5)
    region = np.zeros((32, 32), bool)
    region[:16, :16] = True
    image = grey + 0.1 * region[..., None]
    assert ls.psnr(image, grey, region=region) == pytest.approx(20.0)
    assert ls.psnr(image, grey) == pytest.approx(20.0 + 10.0 * np.log10(4.0))


@pytest.mark.parametrize("metric", METRICS)
def test_bad_regions_are_refused(metric):
    """An empty one, one of another shape, and one of numbers."""
    image = picture(6)
    with pytest.raises(ls.SceneError, match="region is empty"):
        metric(image, image, region=np.zeros(image.shape[:2], bool))
    with pytest.raises(ls.SceneError, match=r"region is bool of shape \(176, 191\), expected booleans of \(176, 192\)"):
        metric(image, image, region=np.ones((176, 191), bool))
    with pytest.raises(ls.SceneError, match="region is float64"):
        metric(image, image, region=np.ones(image.shape[:2]))


def test_a_region_at_the_edge_has_no_windows():
    """Windows lie inside the picture: the outermost pixels are the middle of none."""
    image = picture(7)
    edge = np.zeros(image.shape[:2], bool)
    edge[:5] = True
    for metric in (ls.ssim, ls.ms_ssim):
        with pytest.raises(ls.SceneError, match="region has no pixel whose window lies inside the images"):
            metric(image, image, region=edge)
