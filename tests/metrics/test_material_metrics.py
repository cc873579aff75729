"""Scale of albedo, angles between normals and PSNR of environments, computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.math.directions import panorama_directions
from lumisplat.metrics.materials import channel_scale, environment_psnr, normal_errors

RANDOM = np.random.default_rng(0)


def test_albedo_scale_of_a_channel_is_the_median_ratio_of_true_to_estimated_albedo():
    """A third of the pixels that are far off do not change the scale."""
    found = RANDOM.uniform(0.1, 0.5, (99, 3))
    truth = found * (0.5, 1.0, 1.7)
    truth[:33] = 0.9
    np.testing.assert_allclose(channel_scale(found, truth), (0.5, 1.0, 1.7), rtol=1e-12)
    np.testing.assert_allclose(channel_scale([[0.2] * 3, [0.4] * 3], [[0.2] * 3, [0.8] * 3]), 1.5)


def test_albedo_scale_ignores_black_pixels():
    """A pixel is black in the estimate or the truth; the scale of a channel that is black everywhere is 1."""
    found = np.array([[0.2, 0.0, 0.0], [0.0, 0.3, 0.0], [0.2, 0.3, 0.0]])
    truth = np.array([[0.4, 0.0, 0.5], [0.9, 0.0, 0.5], [0.4, 0.1, 0.5]])
    np.testing.assert_allclose(channel_scale(found, truth), (2.0, 1.0 / 3.0, 1.0))


def test_albedo_scale_of_a_channel_with_few_lit_pixels_is_1():
    """A channel has its median ratio only if more than a fiftieth of the pixels is not black."""
    found, truth = np.full((100, 3), 0.001), np.zeros((100, 3))
    found[:2, 0], truth[:2, 0] = 0.002, 0.5
    found[:1, 1], truth[:1, 1] = 0.002, 0.5
    np.testing.assert_allclose(channel_scale(found, truth), (250.0, 1.0, 1.0))


def test_albedo_scale_is_a_median_weighted_by_pixel_weights():
    """A pixel with more weight than all others together decides."""
    found, truth = np.full((3, 3), 0.5), np.array([[0.1] * 3, [0.2] * 3, [0.4] * 3])
    np.testing.assert_allclose(channel_scale(found, truth, [1.0, 1.0, 3.0]), 0.8)
    np.testing.assert_allclose(channel_scale(found, truth, [1.0, 0.0, 0.5]), 0.2)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 5.0, 90.0, 179.0, 180.0])
def test_normal_errors_are_exact_for_small_angles(degrees):
    """The length of normals does not matter."""
    truth = RANDOM.normal(size=(50, 3))
    truth /= np.linalg.norm(truth, axis=1, keepdims=True)
    side = np.cross(truth, RANDOM.normal(size=3))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    rotated = np.cos(np.radians(degrees)) * truth + np.sin(np.radians(degrees)) * side
    np.testing.assert_allclose(normal_errors(0.3 * rotated, truth), degrees, rtol=1e-9, atol=1e-6)


def test_missing_normal_counts_as_an_error_of_90_degrees():
    """A zero vector stands for a missing normal."""
    assert normal_errors([[0.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]) == pytest.approx(90.0)


def world(height: int) -> np.ndarray:
    """Returns a panorama of any size of the same environment."""
    x, y, z = np.moveaxis(panorama_directions(height, 2 * height), -1, 0)
    return np.stack([0.3 + 0.2 * x, 0.3 + 0.2 * y, 0.3 + 0.1 * z * x], axis=-1)


def test_environment_psnr_does_not_depend_on_image_size_or_scale_of_colour_channels():
    """A coarser, brighter image of the environment has no error; a rotated one has."""
    assert environment_psnr(world(64), world(64)) == np.inf
    assert environment_psnr(world(64) * (2.0, 0.5, 3.0), world(64)) > 120.0
    assert environment_psnr(world(16), world(64)) > 50.0
    assert environment_psnr(world(48), world(64)) > 60.0
    assert environment_psnr(np.roll(world(64), 16, axis=1), world(64)) < 30.0


def test_environment_psnr_weights_pixels_by_solid_angle():
    """A wrong cap around a pole counts by its fraction of the sphere."""
    truth = np.full((64, 128, 3), 0.5)
    found = truth.copy()
    found[:4] = 0.0  # one row of 16 is black instead of display value 0.735
    fraction = (1.0 - np.cos(np.pi / 16.0)) / 2.0
    display = 1.055 * 0.5 ** (1.0 / 2.4) - 0.055
    assert environment_psnr(found, truth) == pytest.approx(-10.0 * np.log10(fraction * display**2), abs=0.15)
