"""Harmonics of linear colours as harmonics of display colours."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.constants import SH_C0
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.scene.ops.colors import display_sh


def colors(sh: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Colours in all directions, shape (D, N, 3)."""
    return np.maximum(np.einsum("dk,nkc->dnc", basis, sh.astype(np.float64)) + 0.5, 0.0)


def test_one_colour_is_exact() -> None:
    """Without view dependence the encoded colour is that of the transfer function."""
    linear = np.linspace(0.0, 1.5, 12).reshape(4, 1, 3)
    sh = display_sh((linear - 0.5) / SH_C0)
    np.testing.assert_allclose(SH_C0 * sh + 0.5, encode_srgb(linear), atol=1e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_no_other_harmonics_are_nearer(degree: int) -> None:
    """The mean square error over many directions is least: changing any coefficient makes it larger."""
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


def test_small_contrasts_follow_the_slope() -> None:
    """For small changes of light the display coefficient is the linear one times the slope of the curve."""
    sh = np.zeros((1, 4, 3))
    sh[0, 2] = 1e-4
    slope = (encode_srgb(0.5 + 1e-6) - encode_srgb(0.5 - 1e-6)) / 2e-6
    np.testing.assert_allclose(display_sh(sh)[0, 2], 1e-4 * slope, rtol=1e-3)
