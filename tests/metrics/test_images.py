"""PSNR, SSIM and FLIP: hand-computed values, and transformations that leave the metrics unchanged."""

from __future__ import annotations

import math
import sys
from typing import Any, cast

import numpy as np
import pytest
from scipy.signal import convolve2d

import lumisplat as ls

METRICS = (ls.metrics.psnr, ls.metrics.ssim, ls.metrics.flip)


def noise_image(seed: int, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    """Returns a noise image with values from 0.1 to 0.9."""
    return np.random.default_rng(seed).uniform(0.1, 0.9, (*shape, 3))


def flat(color: tuple[float, float, float]) -> np.ndarray:
    """Returns an image of one colour."""
    return np.broadcast_to(np.array(color), (32, 32, 3))


def ssim_by_definition(image: np.ndarray, reference: np.ndarray) -> float:
    """Computes SSIM by Wang et al. 2004, equations 13 to 17, window by window."""
    offsets = np.arange(-5, 6)
    bell = np.exp(-(offsets**2) / (2.0 * 1.5**2))
    window = np.outer(bell, bell) / bell.sum() ** 2
    values = []
    for row in range(5, image.shape[0] - 5):
        for column in range(5, image.shape[1] - 5):
            for channel in range(3):
                position = (slice(row - 5, row + 6), slice(column - 5, column + 6), channel)
                x, y = image[position], reference[position]
                mean_x, mean_y = (window * x).sum(), (window * y).sum()
                variance_x, variance_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
                covariance = (window * (x - mean_x) * (y - mean_y)).sum()
                likeness = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
                values.append(likeness / ((mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)))
    return float(np.mean(values))


def flip_of_flat_colors(srgb: tuple[float, float, float], reference: tuple[float, float, float]) -> float:
    """Computes FLIP by Andersson et al. 2020 of two flat images, for which filters and features do nothing.

    By section 4.1, colours are Hunt-adjusted L*a*b*. Their HyAB distance to the power of 0.7 is divided by that of
    green and blue, and mapped by two lines that meet at (0.4, 0.95).
    """

    def hunt(color):
        encoded = np.array(color, np.float64)
        linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
        matrix = np.array(
            [
                [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
                [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
                [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
            ]
        )
        relative = (matrix @ linear) / matrix.sum(axis=1)
        knee = 6.0 / 29.0
        x, y, z = np.where(relative > knee**3, np.cbrt(relative), relative / (3 * knee**2) + 4 / 29)
        lightness = 116 * y - 16
        return np.array([lightness, 0.01 * lightness * 500 * (x - y), 0.01 * lightness * 200 * (y - z)])

    def distance(a, b):
        difference = hunt(a) - hunt(b)
        return (abs(difference[0]) + math.hypot(*difference[1:])) ** 0.7

    fraction = distance(srgb, reference) / distance((0, 1, 0), (0, 0, 1))
    return fraction * 0.95 / 0.4 if fraction < 0.4 else 0.95 + (fraction - 0.4) / 0.6 * 0.05


def test_psnr_matches_hand_computed_values():
    """Values off by 0.1: MSE 0.01, 20 dB. One channel of three: MSE 0.01 / 3, 24.771 dB."""
    grey = np.full((4, 5, 3), 0.5)
    assert ls.metrics.psnr(grey + 0.1, grey) == pytest.approx(20.0)
    red = grey + np.array([0.1, 0.0, 0.0])
    assert ls.metrics.psnr(red, grey) == pytest.approx(10.0 * math.log10(300.0))
    assert ls.metrics.psnr(np.zeros((4, 5, 3)), np.ones((4, 5, 3))) == 0.0


def test_ssim_of_flat_images_is_the_luminance_term():
    """SSIM without variance is (2 m1 m2 + C1) / (m1^2 + m2^2 + C1): of means 0.4 and 0.6, 0.4801 / 0.5201."""
    assert ls.metrics.ssim(np.full((16, 16, 3), 0.4), np.full((16, 16, 3), 0.6)) == pytest.approx(
        0.4801 / 0.5201, abs=1e-9
    )
    assert ls.metrics.ssim(np.zeros((16, 16, 3)), np.ones((16, 16, 3))) == pytest.approx(1e-4 / 1.0001, abs=1e-9)


def test_ssim_matches_the_definition_of_the_paper():
    """The reference evaluates the definition window by window."""
    image, reference = noise_image(1), noise_image(2)
    mixed = 0.7 * reference + 0.3 * image
    assert ls.metrics.ssim(mixed, reference) == pytest.approx(ssim_by_definition(mixed, reference), abs=1e-6)


@pytest.mark.parametrize(
    ("color", "reference"),
    [
        ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        ((0.5, 0.5, 0.5), (0.6, 0.6, 0.6)),
        ((1.0, 0.0, 0.0), (0.2, 0.4, 0.6)),
    ],
)
def test_image_metric_flip_of_flat_images_matches_the_paper(color, reference):
    """The paper's formulas need no filtering here; green on blue gives 1, the largest possible distance."""
    expected = flip_of_flat_colors(color, reference)
    assert ls.metrics.flip(flat(color), flat(reference)) == pytest.approx(expected, abs=2e-4)
    if color == (0.0, 1.0, 0.0):
        assert expected == 1.0


def test_image_metric_flip_is_smaller_on_a_display_with_more_pixels_per_degree():
    """Noise is less visible on a finer display."""
    image, reference = noise_image(1), noise_image(2)
    coarse, usual, fine = (ls.metrics.flip(image, reference, pixels_per_degree=density) for density in (10, 67, 300))
    assert coarse > usual > fine > 0.0


@pytest.mark.parametrize("metric", METRICS)
def test_image_metrics_of_equal_images_have_the_best_value(metric):
    """More noise makes the value worse."""
    reference = noise_image(3)
    noise = np.random.default_rng(4).normal(0.0, 1.0, reference.shape)
    values = [metric(np.clip(reference + size * noise, 0.0, 1.0), reference) for size in (0.0, 0.02, 0.1)]
    best, sign = {ls.metrics.psnr: (math.inf, -1), ls.metrics.ssim: (1.0, -1), ls.metrics.flip: (0.0, 1)}[metric]
    assert values[0] == pytest.approx(best, abs=1e-9)
    assert sign * values[0] < sign * values[1] < sign * values[2]


@pytest.mark.parametrize("metric", METRICS)
def test_image_metrics_are_equal_for_8_bit_images_and_their_float_values(metric):
    """The floats are the bytes over 255."""
    image, reference = ((255 * noise_image(seed)).round().astype(np.uint8) for seed in (5, 6))
    assert metric(image, reference) == pytest.approx(metric(image / 255.0, reference / 255.0), abs=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_image_metrics_do_not_change_if_both_images_are_mirrored(metric):
    """Both images are turned upside down, or mirrored."""
    image, reference = noise_image(7), noise_image(8)
    for mirror in (np.flipud, np.fliplr):
        assert metric(mirror(image), mirror(reference)) == pytest.approx(metric(image, reference), abs=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_image_metrics_refuse_invalid_pairs_of_images(metric):
    """Different sizes, shapes, ranges and NaN each have a different message of one line."""
    image = noise_image(9)
    with pytest.raises(ls.SceneError, match="the image is 32 x 24, its reference 32 x 23"):
        metric(image, image[1:])
    with pytest.raises(ls.SceneError, match=r"reference has shape \(24, 32\), expected \(H, W, 3\)"):
        metric(image, image[..., 0])
    with pytest.raises(ls.SceneError, match=r"image has 2,304 of 2,304 values outside 0..1"):
        metric(image * 255.0, image)
    broken = image.copy()
    broken[0, 0, 0] = np.nan
    with pytest.raises(ls.SceneError, match=r"image has 1 of 2,304 values outside 0..1, or not finite"):
        metric(broken, image)


def test_images_smaller_than_the_ssim_window_are_refused():
    """The message names the metric."""
    with pytest.raises(ls.SceneError, match="ssim compares windows of 11 x 11 pixels, the images are 12 x 10"):
        ls.metrics.ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)))


def test_image_metric_flip_refuses_0_pixels_per_degree():
    """The range is 1 to 1000."""
    with pytest.raises(ls.ConfigError, match="pixels_per_degree is 0"):
        ls.metrics.flip(noise_image(1), noise_image(2), pixels_per_degree=0)
    with pytest.raises(ls.ConfigError, match="pixels_per_degree is '4K'"):
        ls.metrics.flip(noise_image(1), noise_image(2), pixels_per_degree="4K")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    ("metric", "package"), [(ls.metrics.ssim, "skimage.metrics"), (ls.metrics.flip, "flip_evaluator")]
)
def test_missing_metric_packages_are_reported_with_the_pip_command(metric, package, monkeypatch):
    """The error names the extra."""
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ls.errors.MissingExtraError, match=r"pip install 'lumisplat\[metrics\]'"):
        metric(noise_image(1), noise_image(2))


WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def waves_image(seed: int, shape: tuple[int, int] = (176, 192)) -> np.ndarray:
    """Returns a smooth image with noise, with values from 0.05 to 0.95."""
    rng = np.random.default_rng(seed)
    y, x = np.arange(shape[0])[:, None, None], np.arange(shape[1])[:, None]
    waves = np.sin(x * rng.uniform(0.02, 0.3, 3) + y * rng.uniform(0.02, 0.3, 3) + rng.uniform(0.0, 6.0, 3))
    return np.clip(0.5 + 0.3 * waves + 0.05 * rng.normal(size=(*shape, 3)), 0.05, 0.95)


def noisy(image: np.ndarray, size: float) -> np.ndarray:
    """Returns the image with more noise."""
    return np.clip(image + size * np.random.default_rng(99).normal(size=image.shape), 0.0, 1.0)


def ms_ssim_by_convolution(image: np.ndarray, reference: np.ndarray, weights: tuple[float, ...] = WEIGHTS) -> float:
    """Computes MS-SSIM by Wang et al. 2003 with full 2D windows; odd last rows and columns are repeated."""
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
def test_ms_ssim_matches_a_second_implementation_written_for_the_test(noise):
    """The factors of the five scales differ widely."""
    reference = waves_image(1)
    image = noisy(reference, noise)
    expected = ms_ssim_by_convolution(image, reference)
    assert ls.metrics.ms_ssim(image, reference) == pytest.approx(expected, abs=1e-12)
    assert 0.3 < expected < 0.9999


def test_ms_ssim_of_flat_images_is_the_luminance_of_the_coarsest_scale():
    """The value without contrast is (0.4801 / 0.5201) ** 0.1333."""
    dark, light = np.full((161, 170, 3), 0.4), np.full((161, 170, 3), 0.6)
    assert ls.metrics.ms_ssim(dark, light) == pytest.approx((0.4801 / 0.5201) ** 0.1333, abs=1e-9)
    last = 0.2363 / (0.0448 + 0.2856 + 0.3001 + 0.2363)
    assert ls.metrics.ms_ssim(dark, light, scales=4) == pytest.approx((0.4801 / 0.5201) ** last, abs=1e-9)


def test_ms_ssim_with_a_single_scale_equals_ssim():
    """The reference is scikit-image's SSIM."""
    reference = waves_image(2, (40, 33))
    image = noisy(reference, 0.1)
    assert ls.metrics.ms_ssim(image, reference, scales=1) == pytest.approx(ls.metrics.ssim(image, reference), abs=1e-9)


def test_ms_ssim_of_an_inverted_image_is_0():
    """A negative mean of structure counts as 0."""
    reference = waves_image(3)
    assert ls.metrics.ms_ssim(1.0 - reference, reference) == 0.0
    assert ls.metrics.ms_ssim(reference, reference) == pytest.approx(1.0, abs=1e-12)


def test_ms_ssim_accepts_images_of_odd_size():
    """The last row and column are repeated; the weights of two scales sum to 1."""
    reference = waves_image(4, (45, 47))
    image = noisy(reference, 0.1)
    weights = (0.0448 / (0.0448 + 0.2856), 0.2856 / (0.0448 + 0.2856))
    expected = ms_ssim_by_convolution(image, reference, weights)
    assert ls.metrics.ms_ssim(image, reference, scales=2) == pytest.approx(expected, abs=1e-12)


def test_ms_ssim_uses_fewer_than_five_scales_for_small_images():
    """161 pixels suffice for five scales, 160 for four; smaller images are refused."""
    sizes = {161: 5, 160: 4, 81: 4, 80: 3, 21: 2, 20: 1, 11: 1, 10: 0}
    assert {size: ls.metrics.ms_ssim_scales(size, 500) for size in sizes} == sizes
    assert {size: ls.metrics.ms_ssim_scales(500, size) for size in sizes} == sizes
    for size, scales in sizes.items():
        flat = np.full((size, size + 3, 3), 0.5)
        if scales:
            assert ls.metrics.ms_ssim(flat, flat, scales=scales) == pytest.approx(1.0)
        if 0 < scales < 5:
            with pytest.raises(ls.SceneError, match=f"these are {size + 3} x {size}: use scales={scales}"):
                ls.metrics.ms_ssim(flat, flat, scales=scales + 1)
    with pytest.raises(ls.SceneError, match="ms_ssim compares windows of 11 x 11 pixels, the images are 12 x 10"):
        ls.metrics.ms_ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)), scales=1)
    for scales in (0, 6, 2.5):
        with pytest.raises(ls.ConfigError, match="scales is"):
            ls.metrics.ms_ssim(waves_image(1), waves_image(1), scales=cast(Any, scales))


WITH_MS_SSIM = (ls.metrics.psnr, ls.metrics.ssim, ls.metrics.ms_ssim, ls.metrics.flip)


@pytest.mark.parametrize("metric", WITH_MS_SSIM)
def test_image_metrics_ignore_pixels_outside_a_region(metric):
    """Errors inside the region change the metrics."""
    reference = waves_image(5)
    image = noisy(reference, 0.05)
    region = np.zeros(reference.shape[:2], bool)
    region[30:120, 40:150] = True
    value = metric(image, reference, region=region)
    assert metric(np.where(region[..., None], image, 1.0), reference, region=region) == pytest.approx(value, abs=1e-9)
    worse = np.where(region[..., None], noisy(reference, 0.2), image)
    better = metric is ls.metrics.flip
    assert (metric(worse, reference, region=region) > value) == better
    assert metric(image, reference, region=np.ones_like(region)) == pytest.approx(metric(image, reference), abs=1e-9)
    assert metric(np.where(region[..., None], reference, image), reference, region=region) == pytest.approx(
        {ls.metrics.psnr: np.inf, ls.metrics.flip: 0.0}.get(metric, 1.0), abs=1e-9
    )


def test_psnr_of_a_region_is_the_mean_over_its_pixels():
    """Off by 0.1 in a quarter of the image: 20 dB in that quarter, 6.02 dB more over all pixels."""
    grey = np.full((32, 32, 3), 0.5)
    region = np.zeros((32, 32), bool)
    region[:16, :16] = True
    image = grey + 0.1 * region[..., None]
    assert ls.metrics.psnr(image, grey, region=region) == pytest.approx(20.0)
    assert ls.metrics.psnr(image, grey) == pytest.approx(20.0 + 10.0 * np.log10(4.0))


@pytest.mark.parametrize("metric", WITH_MS_SSIM)
def test_image_metrics_refuse_invalid_regions(metric):
    """A region is empty, has another shape, or holds numbers."""
    image = waves_image(6)
    with pytest.raises(ls.SceneError, match="region is empty"):
        metric(image, image, region=np.zeros(image.shape[:2], bool))
    with pytest.raises(ls.SceneError, match=r"region is bool of shape \(176, 191\), expected booleans of \(176, 192\)"):
        metric(image, image, region=np.ones((176, 191), bool))
    with pytest.raises(ls.SceneError, match="region is float64"):
        metric(image, image, region=np.ones(image.shape[:2]))


def test_ssim_refuses_a_region_without_pixels_away_from_the_image_border():
    """Windows lie inside the image, so the outermost pixels are the centre of none."""
    image = waves_image(7)
    edge = np.zeros(image.shape[:2], bool)
    edge[:5] = True
    for metric in (ls.metrics.ssim, ls.metrics.ms_ssim):
        with pytest.raises(
            ls.SceneError, match="no window of 11 x 11 pixels inside the images has its centre in region"
        ):
            metric(image, image, region=edge)
