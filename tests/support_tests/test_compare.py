"""Image comparisons fail on images that differ."""

from __future__ import annotations

import numpy as np
import pytest

from support.compare.images import assert_close, assert_close_outside_band, assert_images_alike


@pytest.fixture
def image() -> np.ndarray:
    """Returns an image of uniform noise in 0..1."""
    return np.random.default_rng(0).uniform(0.0, 1.0, (20, 30, 3))


def test_image_comparisons_pass_for_equal_images(image: np.ndarray) -> None:
    """An image equals itself in every comparison, infinities included."""
    image[3, 4] = np.inf
    assert_close(image, image, atol=0.0)
    assert_close_outside_band(image, image, np.zeros((20, 30), bool), atol=0.0)
    assert_images_alike(image, image, mean=1e-12, within=0.0, share=1.0)


@pytest.mark.parametrize("value", [0.02, -0.02, np.nan, np.inf, -np.inf])
def test_image_comparisons_fail_for_one_wrong_value(image: np.ndarray, value: float) -> None:
    """Every strict comparison finds a single wrong, NaN or infinite value."""
    wrong = image.copy()
    wrong[7, 8, 1] += value
    with pytest.raises(AssertionError):
        assert_close(wrong, image, atol=0.01)
    with pytest.raises(AssertionError):
        assert_close_outside_band(wrong, image, np.zeros((20, 30), bool), atol=0.01)
    with pytest.raises(AssertionError):
        assert_images_alike(wrong, image, mean=0.01, within=0.01, share=1.0)


def test_image_comparison_fails_for_finite_against_infinite_depth(image: np.ndarray) -> None:
    """A finite depth differs from an infinite one, in both directions."""
    depth = image[..., 0].copy()
    depth[2, 2] = np.inf
    for actual, expected in ((depth, image[..., 0]), (image[..., 0], depth)):
        with pytest.raises(AssertionError):
            assert_close(actual, expected, atol=1.0)


def test_image_comparison_fails_for_different_shapes(image: np.ndarray) -> None:
    """The comparison refuses an image whose shape would only match by broadcasting."""
    with pytest.raises(AssertionError, match="shape"):
        assert_close(image[:1], image, atol=1.0)


def test_image_comparison_outside_a_band_tolerates_errors_in_the_band_and_no_others(image: np.ndarray) -> None:
    """A wrong pixel inside the band passes up to the band's own tolerance; outside, the same error fails."""
    band = np.zeros((20, 30), bool)
    band[7, 8] = True
    wrong = image.copy()
    wrong[7, 8] += 0.1
    assert_close_outside_band(wrong, image, band, atol=1e-6, band_atol=0.2)
    with pytest.raises(AssertionError, match="in the band"):
        assert_close_outside_band(wrong, image, band, atol=1e-6, band_atol=0.05)
    with pytest.raises(AssertionError, match="outside the band"):
        assert_close_outside_band(wrong, image, np.roll(band, 1), atol=1e-6, band_atol=0.2)


def test_image_comparison_outside_a_band_fails_if_the_band_covers_the_image(image: np.ndarray) -> None:
    """A band that covers most of the image fails, since the comparison would prove nothing."""
    with pytest.raises(AssertionError, match="too many"):
        assert_close_outside_band(image, image, np.ones((20, 30), bool), atol=1.0)


def test_image_similarity_check_bounds_the_mean_error_and_the_share_of_bad_pixels(image: np.ndarray) -> None:
    """A small error everywhere exceeds the mean bound; a large error in a few pixels exceeds the share bound."""
    with pytest.raises(AssertionError, match="mean absolute"):
        assert_images_alike(image + 0.003, image, mean=0.002, within=0.015, share=0.995)
    few = image.copy()
    few[0, :5] += 0.05
    with pytest.raises(AssertionError, match="of the pixels"):
        assert_images_alike(few, image, mean=0.002, within=0.015, share=0.995)
