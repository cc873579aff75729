"""Affine transforms map covariances of captures by the matrix, and SH by its rotation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.editing.transform import under_affine
from support.files.splat_files import capture

STRETCH = np.array([[2.0, 0.3, 0.0], [-0.2, 0.5, 0.1], [0.4, 0.0, 1.5]])
MIRROR = np.diag([-1.0, 1.0, 1.0])


def covariances(gaussians: ls.Gaussians) -> npt.NDArray[np.float64]:
    """Returns covariance matrices, shape (N, 3, 3)."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz.astype(np.float64)) * gaussians.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def matrix_of(linear: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Returns a transform with a translation, shape (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, (1.0, -2.0, 0.5)
    return matrix


@pytest.mark.parametrize("linear", [STRETCH, MIRROR, STRETCH @ MIRROR, 3.0 * np.eye(3)])
def test_affine_transform_maps_means_covariances_and_normals(linear: npt.NDArray[np.float64]) -> None:
    """Sigma becomes M Sigma M^T, and a mean M x + t; normals stay perpendicular to the surface."""
    before = capture(normals=np.random.default_rng(1).normal(size=(300, 3)))
    after = under_affine(before, matrix_of(linear))
    expected = linear @ covariances(before) @ linear.T
    error = np.abs(covariances(after) - expected).max(axis=(1, 2)) / np.abs(expected).max(axis=(1, 2))
    assert error.max() < 2e-6
    np.testing.assert_allclose(after.means, before.means @ linear.T + (1.0, -2.0, 0.5), atol=2e-6)
    assert before.normals is not None and after.normals is not None
    tangents = np.cross(before.normals, (0.3, 0.5, 0.8))
    np.testing.assert_allclose(np.sum(after.normals * (tangents @ linear.T), axis=1), 0.0, atol=3e-6)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_sh_colours_rotate_and_mirror_with_the_affine_transform(degree: int) -> None:
    """The colour in a rotated or mirrored direction equals the colour in the original direction."""
    before = capture(20, degree)
    turn = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]]) @ MIRROR
    after = under_affine(before, matrix_of(turn))
    directions = even_directions(50)
    seen = np.einsum("dk,nkc->ndc", sh_basis(directions, degree), before.sh)
    turned = np.einsum("dk,nkc->ndc", sh_basis(directions @ turn.T, degree), after.sh)
    np.testing.assert_allclose(turned, seen, atol=2e-6)


def test_affine_transform_of_a_capture_by_a_similarity_equals_the_function_transform() -> None:
    """A rotation with uniform scale gives the result of `lumisplat.transform`."""
    before = capture(degree=3)
    turn = matrix_of(2.0 * np.array([[0.0, -1.0, 0.0], [0.6, 0.0, -0.8], [0.8, 0.0, 0.6]]))
    by_affine, by_transform = under_affine(before, turn), ls.transform(before, turn)
    np.testing.assert_allclose(by_affine.sh, by_transform.sh, atol=1e-6)
    error = np.abs(covariances(by_affine) - covariances(by_transform)).max(axis=(1, 2))
    assert (error / np.abs(covariances(by_transform)).max(axis=(1, 2))).max() < 2e-6


def test_affine_transform_refuses_a_singular_matrix() -> None:
    """A matrix without an inverse is refused."""
    with pytest.raises(ls.SceneError, match="singular"):
        under_affine(capture(5), matrix_of(np.diag([1.0, 1.0, 0.0])))
