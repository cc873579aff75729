"""SH colours on the device agree with the oracle."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.colors import colors_along
from support.oracles.raster_oracle import sh_color
from support.scenes.raster_scenes import random_gaussians


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_device_colours_from_sh_equal_the_oracle_for_each_degree(degree: int) -> None:
    """Colours of a set of degree 3, evaluated up to each degree, are clamped at 0."""
    instance = ls.SplatInstance(random_gaussians(5, degree=3))
    eye = np.array([0.3, -2.0, 1.0])
    along = instance.gaussians.means - eye
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    expected = sh_color(instance, eye, degree)
    np.testing.assert_allclose(colors_along(instance.gaussians, along, degree), expected, atol=2e-6)
