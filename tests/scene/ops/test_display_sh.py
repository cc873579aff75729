"""SH coefficients of linear colours convert to SH coefficients of display-referred colours."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.scene.ops.colors import display_sh


def colors(sh: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Returns the colours of N Gaussians in D directions, shape (D, N, 3)."""
    return np.maximum(np.einsum("dk,nkc->dnc", basis, sh.astype(np.float64)) + 0.5, 0.0)


def test_linear_sh_of_a_view_independent_colour_are_encoded_to_srgb_exactly() -> None:
    """A view-independent colour is encoded by the transfer function exactly."""
    linear = np.linspace(0.0, 1.5, 12).reshape(4, 1, 3)
    sh = display_sh((linear - 0.5) / SH_C0)
    np.testing.assert_allclose(SH_C0 * sh + 0.5, encode_srgb(linear), atol=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_srgb_encoded_sh_have_the_least_mean_squared_error_over_directions(degree: int) -> None:
    """Changing any coefficient increases the mean squared error over many directions."""
    rng = np.random.default_rng(degree)
    sh = rng.normal(0.0, 0.15, (3, (degree + 1) ** 2, 3))
    basis = sh_basis(even_directions(3000), degree)
    wanted = encode_srgb(colors(sh, basis))
    found = display_sh(sh)

    def error(coefficients: np.ndarray) -> float:
        return float(((np.einsum("dk,nkc->dnc", basis, coefficients) + 0.5 - wanted) ** 2).mean())

    least = error(found.astype(np.float64))
    for k in range(sh.shape[1]):
        for step in (-0.02, 0.02):
            moved = found.astype(np.float64)
            moved[:, k] += step
            assert error(moved) > least
    assert least < 0.05**2


def test_small_linear_sh_contrasts_are_encoded_by_the_slope_of_the_srgb_curve() -> None:
    """Small display coefficients are the linear coefficients times the slope of the curve at the mean colour."""
    sh = np.zeros((1, 4, 3))
    sh[0, 2] = 1e-4
    slope = (encode_srgb(0.5 + 1e-6) - encode_srgb(0.5 - 1e-6)) / 2e-6
    np.testing.assert_allclose(display_sh(sh)[0, 2], 1e-4 * slope, rtol=1e-3)
