"""Tests of SH colours on the device."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from support.oracles import raster_oracle as oracles
from support.probes.probe_sh_kernels import probe_sh_colors


def colors(sh: np.ndarray, degree: int, directions: np.ndarray) -> np.ndarray:
    """Returns the device's colours of SH coefficients in N directions, shape (N, 3)."""
    result = wp.zeros(len(directions), dtype=wp.vec3, device="cpu")
    arrays = [wp.array(values.astype(np.float32), dtype=wp.vec3, device="cpu") for values in (sh, directions)]
    wp.launch(probe_sh_colors, len(directions), inputs=[arrays[0], degree, arrays[1], result], device="cpu")
    return result.numpy()


def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Returns directions and weights of a quadrature that is exact for polynomials up to degree 7 on the sphere."""
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = 2.0 * np.pi * np.arange(16) / 16.0
    radius = np.sqrt(1.0 - z**2)
    ring = np.stack([np.cos(phi), np.sin(phi)], axis=-1)
    directions = np.stack([np.append(r * point, height) for r, height in zip(radius, z, strict=True) for point in ring])
    return directions, np.repeat(weights * 2.0 * np.pi / 16.0, 16)


def device_basis() -> np.ndarray:
    """Returns the 16 SH basis functions at the N directions of the quadrature, shape (N, 16).

    The functions are evaluated with one-hot coefficients that are small enough not to be clamped at 0.
    """
    directions, _ = sphere()
    one_hot = 0.1 * np.eye(16)
    return np.stack([colors(np.repeat(c[:, None], 3, axis=1), 3, directions)[:, 0] - 0.5 for c in one_hot], 1) / 0.1


def test_device_sh_basis_functions_are_orthonormal() -> None:
    """The integral of the product of two basis functions is 1 for equal functions and 0 otherwise."""
    basis, (_, weights) = device_basis(), sphere()
    np.testing.assert_allclose(basis.T * weights @ basis, np.eye(16), atol=1e-5)


def test_device_sh_basis_order_and_signs_match_the_oracle() -> None:
    """The oracle writes out the constants of every basis function."""
    np.testing.assert_allclose(device_basis(), oracles.sh_basis(sphere()[0]), atol=2e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_coefficients_above_the_degree_are_ignored(degree: int) -> None:
    """NaN coefficients above the degree do not reach the colour."""
    directions, _ = sphere()
    sh = np.random.default_rng(0).normal(0.0, 0.1, (16, 3))
    cut = np.where(np.arange(16)[:, None] < (degree + 1) ** 2, sh, 0.0)
    expected = np.maximum(oracles.sh_basis(directions) @ cut + 0.5, 0.0)
    np.testing.assert_allclose(colors(np.where(cut == 0.0, np.nan, sh), degree, directions), expected, atol=1e-5)
