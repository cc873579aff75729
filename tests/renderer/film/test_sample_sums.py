"""Sample sums of the film: means and variances of number streams, and noise estimates."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from lumisplat.device.structs.camera import FilmData, PixelData
from lumisplat.renderer.film.adaptive_rays import least_luminance, quantile
from lumisplat.renderer.film.pixel_buffers import pixel_sums
from lumisplat.renderer.sample_budget import is_noise_checked
from lumisplat.runtime.buffers import Buffers, rows_of
from support.probes.probe_film_kernels import add_stream, read_pixel


def statistics(values: np.ndarray, least: float = 0.01) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Returns mean, variance, mean alpha and relative variance of N samples, shape (N, 3), of an unlit frame's film."""
    buffers = Buffers("cpu")
    row = FilmData()
    row.width, row.height = 1, 1
    row.pixels = PixelData()
    row.count = buffers.get("count", wp.int32, 1)
    row.sums, block = pixel_sums(buffers, 1, is_lit=False)
    row.count.zero_()  # pyright: ignore[reportUnknownMemberType]
    block.zero_()
    film = buffers.upload("film", FilmData, rows_of([row]))
    out, noise = (wp.zeros(3, dtype=kind, device="cpu") for kind in (wp.vec3, wp.float32))
    samples = wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(add_stream, 1, [samples, film], device="cpu")
    wp.launch(read_pixel, 1, [least, film, out, noise], device="cpu")
    mean, variance, alpha = out.numpy().astype(np.float64)
    return mean, variance, float(alpha[0]), float(noise.numpy()[0])


STREAMS = {
    "even": lambda rng, n: rng.random((n, 3)),
    "far from zero": lambda rng, n: 1000.0 + rng.normal(0.0, 0.05, (n, 3)),
    "fireflies": lambda rng, n: 0.1 + 1e5 * (rng.random((n, 3)) < 1e-3),
    "rising": lambda _, n: np.linspace(0.0, 7.0, n)[:, None] * np.array([1.0, 1e-3, 1e3]),
}


@pytest.mark.parametrize("stream", STREAMS.values(), ids=STREAMS.keys())
def test_film_mean_and_variance_of_100000_samples_match_float64(stream) -> None:
    """Running means in float32 would fail; the film's sums agree with float64 up to rounding of the result."""
    values = stream(np.random.default_rng(5), 100_000).astype(np.float32)
    mean, variance, alpha, _ = statistics(values)
    exact = values.astype(np.float64)
    np.testing.assert_allclose(mean, exact.mean(axis=0), rtol=1e-7)
    assert alpha == pytest.approx(exact[:, 0].mean(), rel=1e-7)
    np.testing.assert_allclose(variance, exact.var(axis=0, ddof=1), rtol=1e-6)


def test_relative_variance_is_luminance_variance_over_squared_mean_luminance() -> None:
    """If the mean is darker than the minimum, the minimum replaces it; the relative variance of one sample is inf."""
    values = np.random.default_rng(6).random((64, 3)) * (0.2, 1.0, 3.0)
    exact = values.astype(np.float32).astype(np.float64)
    weights = np.array([0.2126, 0.7152, 0.0722])
    spread = exact.var(axis=0, ddof=1) @ weights
    assert statistics(values)[3] == pytest.approx(spread / (exact.mean(axis=0) @ weights) ** 2, rel=1e-5)
    assert statistics(values, least=2.0)[3] == pytest.approx(spread / 4.0, rel=1e-5)
    assert statistics(values[:1])[3] == np.inf
    assert (exact @ weights).var(ddof=1) <= spread, "the estimate bounds the variance of luminance"
    grey = values[:, :1] * np.ones(3)
    assert statistics(grey)[3] == pytest.approx(grey[:, 0].var(ddof=1) / grey.mean() ** 2, rel=1e-5)


def test_film_measures_zero_variance_for_pixels_whose_samples_are_equal() -> None:
    """10,000 equal samples have no variance beyond rounding."""
    _, variance, _, noise = statistics(np.full((10_000, 3), 0.1))
    assert (variance >= 0.0).all() and variance.max() < 1e-15 and noise < 1e-13


def test_noise_estimates_include_darker_pixels_at_higher_exposure() -> None:
    """Two stops of exposure quarter the minimum luminance of lit frames; unlit frames use a display value."""
    assert least_luminance(0.0, is_lit=True) == pytest.approx(0.01)
    assert least_luminance(2.0, is_lit=True) == pytest.approx(0.0025)
    assert least_luminance(2.0, is_lit=False) == pytest.approx(0.0998, abs=1e-4)


def test_quantile_of_pixel_noise_is_one_of_the_values_without_interpolation() -> None:
    """The quantile is the smallest value that the given fraction does not exceed."""
    values = np.random.default_rng(7).permutation(np.arange(1, 101)).astype(np.float32)
    assert quantile(values, 0.95) == 95.0
    assert quantile(values[:1], 0.95) == values[0]
    assert np.isnan(quantile(values[:0], 0.95))
    values[:4] = np.inf
    assert np.isfinite(quantile(values, 0.95))


def test_noise_of_a_frame_is_estimated_eight_times_per_doubling_of_its_samples() -> None:
    """The first estimate is made at 16 samples."""
    checks = [n for n in range(1000) if is_noise_checked(n)]
    assert checks[:9] == [16, 18, 20, 22, 24, 26, 28, 30, 32]
    assert [n for n in checks if 256 <= n < 512] == list(range(256, 512, 32))
