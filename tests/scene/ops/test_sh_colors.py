"""Colours of harmonics, against the tests' own twin."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.sh_colors import colors_along, sh_basis
from support.oracles.raster_oracle import sh_basis as twin_basis
from support.oracles.raster_oracle import sh_color
from support.scenes.raster_scenes import random_gaussians


def directions(count: int) -> np.ndarray:
    """Random unit vectors."""
    vectors = np.random.default_rng(3).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_basis_is_the_twins() -> None:
    """All sixteen, in order, sign and size; lower degrees are its beginning."""
    along = directions(100)
    np.testing.assert_allclose(sh_basis(along, 3), twin_basis(along).T, atol=1e-12)
    for degree in range(3):
        np.testing.assert_array_equal(sh_basis(along, degree), sh_basis(along, 3)[: (degree + 1) ** 2])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_are_the_twins(degree: int) -> None:
    """Clamped colours of a set of degree 3, up to each degree."""
    instance = ls.SplatInstance(random_gaussians(5, degree=3))
    eye = np.array([0.3, -2.0, 1.0])
    along = instance.gaussians.means - eye
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    expected = sh_color(instance, eye, degree)
    np.testing.assert_allclose(colors_along(instance.gaussians, along, degree), expected, atol=2e-6)
