"""Mirrored captures have mirrored colours and covariances."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from lumisplat.io.splats.columns import columns_from_gaussians, mirror_axes
from support.files.splat_files import capture
from support.oracles.raster_oracle import rotation_from_quaternion, sh_basis

SIGNS = list(itertools.product([1, -1], repeat=3))


@pytest.mark.parametrize("signs", SIGNS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_mirroring_sh_along_axes_preserves_colours(signs: tuple[int, int, int], degree: int) -> None:
    """SH of a mirrored capture in a mirrored direction equal the original's in the original direction."""
    columns = columns_from_gaussians(capture(30, degree))
    directions = np.random.default_rng(1).normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = (degree + 1) ** 2
    before = np.einsum("nk,nkc->nc", sh_basis(directions)[:, :count], columns.sh)
    after = np.einsum("nk,nkc->nc", sh_basis(directions * signs)[:, :count], mirror_axes(columns, signs).sh)
    np.testing.assert_allclose(after, before, atol=1e-6)


@pytest.mark.parametrize("signs", SIGNS)
def test_mirroring_a_gaussian_mirrors_covariance_mean_and_normal(signs: tuple[int, int, int]) -> None:
    """The mirrored covariance is S Sigma S, for the diagonal matrix S of the signs."""
    columns = columns_from_gaussians(capture(30, normals=np.tile([0.6, 0.0, 0.8], (30, 1))))
    after = mirror_axes(columns, signs)
    flip = np.diag(signs)

    def covariance(wxyz: np.ndarray) -> np.ndarray:
        rotation = rotation_from_quaternion(wxyz.astype(np.float64))
        return rotation @ (np.exp(2.0 * columns.log_scales)[:, :, None] * rotation.transpose(0, 2, 1))

    np.testing.assert_allclose(
        covariance(after.rotations_wxyz), flip @ covariance(columns.rotations_wxyz) @ flip, atol=1e-6
    )
    np.testing.assert_array_equal(after.means, columns.means @ flip)
    np.testing.assert_array_equal(after.normals, columns.normals @ flip)
