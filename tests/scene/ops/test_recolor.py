"""`scale_light` scales linear light in display-referred, view-dependent colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb
from lumisplat.scene.ops.colors import scale_light
from support.oracles.raster_oracle import sh_basis


def gaussians(count: int, coefficients: int = 16, seed: int = 0) -> ls.Gaussians:
    """Returns random Gaussians whose view-dependent colours dip below 0 and rise above 1."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(0.0, 0.2, (count, coefficients, 3))
    sh[:, 0] = (rng.uniform(-0.1, 1.2, (count, 3)) - 0.5) / SH_C0
    return ls.Gaussians(
        means=rng.normal(size=(count, 3)),
        rotations_wxyz=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.1, 1.0, (count, 3)),
        opacities=rng.random(count),
        sh=sh,
        normals=rng.normal(size=(count, 3)),
    )


def mean_color(asset: ls.Gaussians) -> np.ndarray:
    """Returns the display-referred colour without its view-dependent part, unclamped."""
    return asset.sh[:, 0].astype(np.float64) * SH_C0 + 0.5


def color_towards(asset: ls.Gaussians, direction: np.ndarray) -> np.ndarray:
    """Returns the clamped colours of N Gaussians towards a direction, max(SH + 0.5, 0), shape (N, 3)."""
    basis = sh_basis(direction)[: asset.sh.shape[1]]
    return np.maximum(np.einsum("k,nkc->nc", basis, asset.sh.astype(np.float64)) + 0.5, 0.0)


def test_scale_light_multiplies_the_linear_mean_colour_of_gaussians_by_the_factor() -> None:
    """The decoded mean colour is multiplied by the factor, for each channel and each Gaussian."""
    before = gaussians(500)
    factors = np.random.default_rng(1).uniform(0.0, 3.0, (500, 3))
    after = scale_light(before, factors)
    bright = mean_color(before) > 1e-4
    ratio = decode_srgb(mean_color(after))[bright] / decode_srgb(mean_color(before))[bright]
    assert bright.sum() > 1000
    np.testing.assert_allclose(ratio, factors[bright], rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_scale_light_multiplies_a_gaussians_colours_by_one_factor_in_all_directions(coefficients: int) -> None:
    """max(SH + 0.5, 0) scales by the same factor in all directions, so that highlights keep their contrast."""
    before = gaussians(200, coefficients)
    after = scale_light(before, np.random.default_rng(1).uniform(0.1, 2.0, 200))
    directions = np.random.default_rng(2).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen_before = np.array([color_towards(before, direction) for direction in directions])
    seen_after = np.array([color_towards(after, direction) for direction in directions])
    gain = seen_after.max(axis=0) / np.maximum(seen_before.max(axis=0), 1e-9)
    np.testing.assert_allclose(seen_after, gain * seen_before, atol=2e-6)


def test_scale_light_multiplies_negative_display_colours_by_the_factor() -> None:
    """Negative display values lie on the linear part of the sRGB curve, so the factor applies to them directly."""
    black = ls.Gaussians(np.zeros((1, 3)), [[1, 0, 0, 0]], np.ones((1, 3)), [1.0], np.full((1, 1, 3), -0.6 / SH_C0))
    np.testing.assert_allclose(mean_color(scale_light(black, [0.5]))[0], -0.05, atol=1e-6)


def test_scale_light_by_zero_makes_gaussians_black_from_all_directions() -> None:
    """At factor 0, the colour is black from all directions."""
    dark = scale_light(gaussians(100), np.zeros(100))
    for direction in np.eye(3):
        assert np.abs(color_towards(dark, direction)).max() < 1e-6


def test_scale_light_by_one_changes_no_bits() -> None:
    """Factor 1 leaves a channel identical, and only ``sh`` becomes another array."""
    before = gaussians(50)
    factors = np.ones((50, 3))
    factors[7, 1] = 0.5
    after = scale_light(before, factors)
    changed = after.sh != before.sh
    assert changed[7, :, 1].any()
    changed[7, :, 1] = False
    assert not changed.any()
    for name, values in before.arrays().items():
        assert name == "sh" or after.arrays()[name] is values, name
    assert scale_light(before, np.ones(50)) is before


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        (np.ones(4), r"shape \(4,\), expected \(5,\) or \(5, 3\)"),
        (np.ones((5, 1)), r"shape \(5, 1\)"),
        ([1, 1, -0.1, 1, 1], "1 of 5 are negative .first at index 2"),
        ([1, np.nan, np.inf, 1, 1], "2 non-finite"),
    ],
)
def test_scale_light_refuses_factors_of_invalid_shape_or_value(factors: npt.ArrayLike, message: str) -> None:
    """Invalid shapes and numbers are refused."""
    with pytest.raises(ls.SceneError, match=message):
        scale_light(gaussians(5), factors)
