"""PSNR, SSIM and FLIP: values computed by hand, and changes that must not change them."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

import lumisplat as ls

METRICS = (ls.psnr, ls.ssim, ls.flip)


def picture(seed: int, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    """A picture of noise, 0.1 to 0.9."""
    return np.random.default_rng(seed).uniform(0.1, 0.9, (*shape, 3))


def flat(color: tuple[float, float, float]) -> np.ndarray:
    """A picture of one colour."""
    return np.broadcast_to(np.array(color), (32, 32, 3))


def ssim_by_definition(image: np.ndarray, reference: np.ndarray) -> float:
    """Wang et al. 2004, equations 13 to 17, window by window."""
    offsets = np.arange(-5, 6)
    bell = np.exp(-(offsets**2) / (2.0 * 1.5**2))
    window = np.outer(bell, bell) / bell.sum() ** 2
    values = []
    for row in range(5, image.shape[0] - 5):
        for column in range(5, image.shape[1] - 5):
            for channel in range(3):
                place = (slice(row - 5, row + 6), slice(column - 5, column + 6), channel)
                x, y = image[place], reference[place]
                mean_x, mean_y = (window * x).sum(), (window * y).sum()
                variance_x, variance_y = (window * (x - mean_x) ** 2).sum(), (window * (y - mean_y) ** 2).sum()
                covariance = (window * (x - mean_x) * (y - mean_y)).sum()
                likeness = (2 * mean_x * mean_y + 1e-4) * (2 * covariance + 9e-4)
                values.append(likeness / ((mean_x**2 + mean_y**2 + 1e-4) * (variance_x + variance_y + 9e-4)))
    return float(np.mean(values))


def flip_of_flat_colors(srgb: tuple[float, float, float], reference: tuple[float, float, float]) -> float:
    """Andersson et al. 2020 for two pictures of one colour each: filters change nothing, and there are no features.

    Section 4.1: Hunt-adjusted L*a*b*, the HyAB distance to the power of 0.7, divided by that of green and blue, and
    mapped by two lines that meet at (0.4, 0.95).
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

    share = distance(srgb, reference) / distance((0, 1, 0), (0, 0, 1))
    return share * 0.95 / 0.4 if share < 0.4 else 0.95 + (share - 0.4) / 0.6 * 0.05


def test_psnr_by_hand():
    """All values off by 0.1: MSE 0.01, 20 dB. One channel of three: MSE 0.01 / 3, 24.771 dB."""
    grey = np.full((4, 5, 3), 0.5)
    assert ls.psnr(grey + 0.1, grey) == pytest.approx(20.0)
    red = grey + np.array([0.1, 0.0, 0.0])
    assert ls.psnr(red, grey) == pytest.approx(10.0 * math.log10(300.0))
    assert ls.psnr(np.zeros((4, 5, 3)), np.ones((4, 5, 3))) == 0.0


def test_ssim_of_flat_pictures():
    """Without variance, SSIM is (2 m1 m2 + C1) / (m1^2 + m2^2 + C1): of 0.4 and 0.6, 0.4801 / 0.5201."""
    assert ls.ssim(np.full((16, 16, 3), 0.4), np.full((16, 16, 3), 0.6)) == pytest.approx(0.4801 / 0.5201, abs=1e-9)
    assert ls.ssim(np.zeros((16, 16, 3)), np.ones((16, 16, 3))) == pytest.approx(1e-4 / 1.0001, abs=1e-9)


def test_ssim_is_that_of_the_paper():
    """The mean of the definition's values, window by window."""
    image, reference = picture(1), picture(2)
    mixed = 0.7 * reference + 0.3 * image
    assert ls.ssim(mixed, reference) == pytest.approx(ssim_by_definition(mixed, reference), abs=1e-6)


@pytest.mark.parametrize(
    ("color", "reference"),
    [
        ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        ((0.5, 0.5, 0.5), (0.6, 0.6, 0.6)),
        ((1.0, 0.0, 0.0), (0.2, 0.4, 0.6)),
    ],
)
def test_flip_of_flat_pictures(color, reference):
    """The value of the paper's formulas without filtering; 1 for green on blue, the largest possible distance."""
    expected = flip_of_flat_colors(color, reference)
    assert ls.flip(flat(color), flat(reference)) == pytest.approx(expected, abs=2e-4)
    if color == (0.0, 1.0, 0.0):
        assert expected == 1.0


def test_flip_grows_with_the_size_of_pixels():
    """Noise is less visible on a finer display."""
    image, reference = picture(1), picture(2)
    coarse, usual, fine = (ls.flip(image, reference, pixels_per_degree=density) for density in (10, 67, 300))
    assert coarse > usual > fine > 0.0


@pytest.mark.parametrize("metric", METRICS)
def test_a_picture_is_its_own_best_reference(metric):
    """Equal pictures have the best value, and more noise makes it worse."""
    reference = picture(3)
    noise = np.random.default_rng(4).normal(0.0, 1.0, reference.shape)
    values = [metric(np.clip(reference + size * noise, 0.0, 1.0), reference) for size in (0.0, 0.02, 0.1)]
    best, sign = {ls.psnr: (math.inf, -1), ls.ssim: (1.0, -1), ls.flip: (0.0, 1)}[metric]
    assert values[0] == pytest.approx(best, abs=1e-9)
    assert sign * values[0] < sign * values[1] < sign * values[2]


@pytest.mark.parametrize("metric", METRICS)
def test_bytes_are_their_shares_of_255(metric):
    """A PNG's bytes and the same values as floats are one picture."""
    image, reference = ((255 * picture(seed)).round().astype(np.uint8) for seed in (5, 6))
    assert metric(image, reference) == pytest.approx(metric(image / 255.0, reference / 255.0), abs=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_turned_pictures_are_as_near(metric):
    """Both pictures upside down, or mirrored, change nothing."""
    image, reference = picture(7), picture(8)
    for turn in (np.flipud, np.fliplr):
        assert metric(turn(image), turn(reference)) == pytest.approx(metric(image, reference), abs=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_what_is_no_pair_of_pictures_is_refused(metric):
    """Different sizes, shapes, ranges and NaN each have their own message of one line."""
    image = picture(9)
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


def test_small_pictures_have_no_ssim():
    """A picture smaller than the window is refused."""
    with pytest.raises(ls.SceneError, match="ssim compares windows of 11 x 11 pixels, the images are 12 x 10"):
        ls.ssim(np.zeros((10, 12, 3)), np.zeros((10, 12, 3)))


def test_flip_checks_its_display():
    """A display without pixels is refused."""
    with pytest.raises(ls.ConfigError, match="pixels_per_degree is 0"):
        ls.flip(picture(1), picture(2), pixels_per_degree=0)
    with pytest.raises(ls.ConfigError, match="pixels_per_degree is '4K'"):
        ls.flip(picture(1), picture(2), pixels_per_degree="4K")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(("metric", "package"), [(ls.ssim, "skimage.metrics"), (ls.flip, "flip_evaluator")])
def test_missing_packages_are_named(metric, package, monkeypatch):
    """Without its package, a metric says how to install it."""
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ls.MissingExtraError, match=r"pip install 'lumisplat\[metrics\]'"):
        metric(picture(1), picture(2))
