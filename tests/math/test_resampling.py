"""Area averages and bicubic interpolation, against explicit sums and polynomials."""

from __future__ import annotations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from lumisplat.math.resampling import area_mean, cubic_samples


def overlaps(size: int, count: int) -> np.ndarray:
    """Returns how much of each of ``count`` output pixels lies in each of ``size`` input pixels; rows sum to 1."""
    edges = np.arange(count + 1) * size / count
    pixels = np.arange(size)
    low, high = np.maximum(edges[:-1, None], pixels), np.minimum(edges[1:, None], pixels + 1)
    return np.maximum(high - low, 0.0) * count / size


@settings(max_examples=60)
@given(st.integers(1, 40), st.integers(1, 40), st.data())
def test_area_mean_downscaling_weights_pixels_by_their_overlap_with_the_new_pixel(height, width, data):
    """Every smaller size matches explicit overlap matrices in float64, including fractional pixels."""
    rows, columns = data.draw(st.integers(1, height)), data.draw(st.integers(1, width))
    image = np.random.default_rng(height * 41 + width).integers(0, 256, (height, width, 3)).astype(np.uint8)
    expected = np.einsum("jy,ix,yxc->jic", overlaps(height, rows), overlaps(width, columns), image.astype(np.float64))
    found = area_mean(image, columns, rows)
    assert found.dtype == np.float32 and found.shape == (rows, columns, 3)
    np.testing.assert_allclose(found, expected, atol=2e-4)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_bicubic_interpolation_reproduces_monotonic_quadratics(kind):
    """Catmull-Rom cubics are exact for monotonic quadratics away from the edge."""
    y, x = np.mgrid[:12, :14] + 0.5
    image = np.stack([0.1 * x**2 + 0.2 * x * y, x + 3.0 * y], axis=-1).astype(kind)
    points = np.random.default_rng(1).uniform((2.5, 2.5), (11.5, 9.5), (5, 9, 2))
    px, py = points[..., 0], points[..., 1]
    expected = np.stack([0.1 * px**2 + 0.2 * px * py, px + 3.0 * py], axis=-1)
    found = cubic_samples(image, points)
    assert found.dtype == kind
    np.testing.assert_allclose(found, expected, rtol=2e-5 if kind is np.float32 else 1e-12)


def test_bicubic_interpolation_does_not_overshoot_steps():
    """A step stays within its two values, pixel centres return their pixels, and the edge extends outwards."""
    image = np.zeros((6, 6, 1))
    image[:, 3:] = 1.0
    points = np.stack(np.meshgrid(np.linspace(-3.0, 9.0, 49), np.linspace(-3.0, 9.0, 25)), axis=-1)
    found = cubic_samples(image, points)
    assert found.min() == 0.0 and found.max() == 1.0
    centres = np.stack(np.meshgrid(np.arange(6) + 0.5, np.arange(6) + 0.5), axis=-1, dtype=np.float64)
    noise = np.random.default_rng(2).uniform(size=(6, 6, 3))
    np.testing.assert_allclose(cubic_samples(noise, centres), noise, atol=1e-15)
    np.testing.assert_allclose(cubic_samples(noise, centres[:1] - (0.0, 5.0)), noise[:1], atol=1e-15)
