"""Compares images, with failure messages that report which values differ, where and by how much."""

from __future__ import annotations

import numpy as np


def assert_close(actual: np.ndarray, expected: np.ndarray, *, atol: float, name: str = "image") -> None:
    """Asserts that every value is within ``atol`` of the expected one; infinities must coincide, NaN always fails."""
    difference = _difference(actual, expected, name)
    worst = np.unravel_index(difference.argmax(), difference.shape)
    assert difference[worst] <= atol, (
        f"{name} differs by {difference[worst]:.3g} at {tuple(int(i) for i in worst)} "
        f"({actual[worst]} for {expected[worst]}); {np.count_nonzero(difference > atol)} values beyond {atol:g}"
    )


def assert_close_outside_band(
    actual: np.ndarray,
    expected: np.ndarray,
    band: np.ndarray,
    *,
    atol: float,
    band_atol: float = np.inf,
    band_share: float = 0.25,
    name: str = "image",
) -> None:
    """Asserts errors of at most ``atol`` at pixels outside ``band``, and of at most ``band_atol`` inside.

    The band marks the pixels at which rounding may flip a decision. It may cover at most ``band_share`` of the image,
    so that the comparison still tests most pixels strictly.
    """
    assert band.mean() <= band_share, f"{name}: the band covers {band.mean():.0%} of the pixels, too many to compare"
    per_pixel = _difference(actual, expected, name).reshape(*band.shape, -1).max(axis=-1)
    for region, limit, where in ((~band, atol, "outside the band"), (band, band_atol, "in the band")):
        off = region & ~(per_pixel <= limit)
        first = tuple(int(i) for i in np.argwhere(off)[0]) if off.any() else None
        assert first is None, (
            f"{name} differs {where} at {np.count_nonzero(off)} pixels by more than {limit:g}, "
            f"first at {first}: {actual[first]} for {expected[first]} (largest {per_pixel[region].max():.3g})"
        )


def assert_images_alike(
    actual: np.ndarray, expected: np.ndarray, *, mean: float, within: float, share: float, name: str = "image"
) -> None:
    """Asserts a mean absolute error below ``mean``, and errors up to ``within`` at ``share`` of the pixels or more."""
    difference = _difference(actual, expected, name)
    error = difference.mean()
    alike = (difference.reshape(*actual.shape[:2], -1).max(axis=-1) <= within).mean()
    assert error < mean, f"{name}: mean absolute error {error:.5f}, expected below {mean:.5f}"
    assert alike >= share, f"{name}: {alike:.3%} of the pixels within {within:.4f}, expected {share:.1%}"


def _difference(actual: np.ndarray, expected: np.ndarray, name: str) -> np.ndarray:
    assert actual.shape == expected.shape, f"{name} has shape {actual.shape}, expected {expected.shape}"
    actual, expected = np.asarray(actual, dtype=np.float64), np.asarray(expected, dtype=np.float64)
    assert not np.isnan(actual).any(), f"{name} has {np.isnan(actual).sum()} NaN"
    assert not np.isnan(expected).any(), f"the expected {name} has NaN"
    with np.errstate(invalid="ignore"):
        return np.where(actual == expected, 0.0, np.abs(actual - expected))
