"""Real spherical harmonics: orthonormal in any degree, and equal to the basis of captures up to degree 3."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.math.sh import sh_basis, sh_gradient
from support.oracles.raster_oracle import sh_basis as twin_basis
from support.scenes.sphere import sphere_quadrature, unit


def test_sh_basis_functions_are_orthonormal_up_to_degree_8() -> None:
    """Integrals of products over the sphere are 1 for equal functions and 0 for others, up to degree 8."""
    directions, weights = sphere_quadrature(10)
    basis = sh_basis(directions, 8)
    np.testing.assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(81), atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_basis_functions_have_order_signs_and_scale_as_in_gaussian_captures(degree: int) -> None:
    """Order, signs and scale match captures, so that coefficients of captures and of probes have the same meaning."""
    directions = unit(0, 100)
    expected = twin_basis(directions)[:, : (degree + 1) ** 2]
    np.testing.assert_allclose(sh_basis(directions, degree), expected, atol=1e-12)


def test_sh_basis_of_lower_degree_is_a_prefix_of_higher_degrees() -> None:
    """Each basis function has the same bits whatever the highest degree is."""
    directions = unit(0, 100)
    highest = sh_basis(directions, 8)
    for degree in range(8):
        np.testing.assert_array_equal(sh_basis(directions, degree), highest[:, : (degree + 1) ** 2])


def test_sh_gradients_equal_central_differences_on_the_sphere() -> None:
    """In two directions across each of many, the poles among them; along a direction the gradient is 0."""
    directions = np.concatenate([unit(1, 20), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    found = sh_gradient(directions, 8)
    assert found.shape == (22, 81, 3)
    np.testing.assert_allclose(np.einsum("nki,ni->nk", found, directions), 0.0, atol=1e-12)
    for axis in ([0.2, 1.0, 0.0], [1.0, 0.0, 0.1]):
        across = np.cross(directions, axis)
        ends = []
        for step in (1e-5, -1e-5):
            moved = directions + step * across
            ends.append(sh_basis(moved / np.linalg.norm(moved, axis=1, keepdims=True), 8))
        np.testing.assert_allclose(
            np.einsum("nki,ni->nk", found, across), (ends[0] - ends[1]) / 2e-5, atol=1e-7, err_msg=str(axis)
        )


def test_sh_basis_accepts_directions_in_arrays_of_any_shape_and_at_the_poles() -> None:
    """Leading axes are preserved, and the poles are finite."""
    poles = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    basis = sh_basis(poles, 4)
    assert basis.shape == (1, 2, 25)
    zonal = [level * level + level for level in range(5)]
    expected = np.sqrt((2 * np.arange(5) + 1) / (4 * np.pi))
    np.testing.assert_allclose(basis[0, 0, zonal], expected, atol=1e-12)
    np.testing.assert_allclose(basis[0, 1, zonal], expected * (-1.0) ** np.arange(5), atol=1e-12)
    np.testing.assert_array_equal(np.delete(basis, zonal, axis=2), 0.0)
