"""A transformed capture looks the same to an equally transformed camera: SH rotate exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.sh import sh_basis, sh_rotation
from lumisplat.math.transforms import quaternions_from_matrices, rotation_from_degrees, rotation_matrix
from support.kinds import present
from support.scenes.raster_scenes import random_gaussians, rotation
from support.scenes.sphere import unit


def random_rotation(seed: int) -> np.ndarray:
    """Returns a random rotation."""
    return rotation_matrix(np.random.default_rng(seed).normal(size=4))


@pytest.mark.parametrize("seed", range(5))
def test_rotated_sh_have_the_original_values_in_rotated_directions(seed: int) -> None:
    """The law holds up to degree 8 and rounding in float64."""
    turn, directions = random_rotation(seed), unit(1, 200)
    matrix = sh_rotation(turn, 8)
    coefficients = np.random.default_rng(seed).normal(size=81)
    before, after = sh_basis(directions, 8) @ coefficients, sh_basis(directions @ turn.T, 8) @ (matrix @ coefficients)
    np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(81), atol=1e-12)


def test_sh_coefficients_of_degree_1_rotate_like_a_vector() -> None:
    """Degree 1 is (-y, z, -x): a quarter turn about z takes x to y and y to -x."""
    turned = sh_rotation(rotation_from_degrees(np.array([0.0, 0.0, 90.0])), 1)
    x, y, z = np.array([0, 0, 0, -1.0]), np.array([0, -1.0, 0, 0]), np.array([0, 0, 1.0, 0])
    np.testing.assert_allclose(turned @ x, y, atol=1e-15)
    np.testing.assert_allclose(turned @ y, -x, atol=1e-15)
    np.testing.assert_allclose(turned @ z, z, atol=1e-15)


def test_rotation_from_degrees_rotates_first_about_x_then_about_y_then_about_z() -> None:
    """A quarter turn about x takes y to z, which the following quarter turn about z leaves unchanged."""
    turn = rotation_from_degrees(np.array([90.0, 0.0, 90.0]))
    np.testing.assert_allclose(turn @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(turn @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def moved_camera(camera: ls.Camera, new_from_old: np.ndarray, scale: float) -> ls.Camera:
    """Returns the camera transformed together with the world."""
    world_from_camera = new_from_old @ np.linalg.inv(np.asarray(camera.camera_from_world, np.float64))
    world_from_camera[:3, :3] /= scale
    return replace(camera, camera_from_world=np.linalg.inv(world_from_camera), near=scale * camera.near)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE])
@pytest.mark.parametrize(("scale", "seed"), [(1.0, 0), (2.5, 1), (0.3, 2)])
def test_capture_and_camera_transformed_together_give_the_same_frame(
    pipeline: ls.Pipeline, scale: float, seed: int
) -> None:
    """A capture of degree 3 and a camera, rotated, scaled and moved alike, give the same frame."""
    capture = random_gaussians(4, count=200, degree=3)
    camera = ls.Camera.look_at((0.4, -0.3, 0.0), (0, 0, 4), (0, -1, 0), width=96, height=72, fov_y=0.8, near=0.01)
    new_from_old = np.eye(4)
    new_from_old[:3, :3] = scale * random_rotation(seed)
    new_from_old[:3, 3] = (3.0, -2.0, 1.0)
    moved = ls.transform(capture, new_from_old)
    config = ls.RenderConfig(pipeline=pipeline, background=(0.0, 0.0, 0.0))
    before = ls.render(ls.Scene(splats=[capture]), camera, config, device="cpu")
    after = ls.render(ls.Scene(splats=[moved]), moved_camera(camera, new_from_old, scale), config, device="cpu")
    flat = ls.render(ls.Scene(splats=[ls.editing.limit_sh_degree(capture, 0)]), camera, config, device="cpu")
    # View dependence matters here; float32 coordinates of about 10 move edges of footprints slightly.
    assert np.abs(flat.color - before.color).max() > 0.2
    assert ls.metrics.psnr(np.clip(after.color, 0, 1), np.clip(before.color, 0, 1)) > 70.0
    # The transformed capture renders like the original with an instance transform.
    placed = ls.Scene(splats=[ls.SplatInstance(capture, new_from_old)])
    instance = ls.render(placed, moved_camera(camera, new_from_old, scale), config, device="cpu")
    assert ls.metrics.psnr(np.clip(after.color, 0, 1), np.clip(instance.color, 0, 1)) > 70.0


def test_transform_rotates_covariances_and_normals_of_a_capture() -> None:
    """Covariances become s^2 R C R^T, normals rotate, and arrays without direction are the same objects."""
    rng = np.random.default_rng(0)
    normals = unit(3, 150)
    capture = random_gaussians(6, normals=normals, roughness=rng.random(150), comments=("kept",))
    turn = random_rotation(9)
    matrix = np.eye(4)
    matrix[:3, :3] = turn
    moved = ls.transform(capture, matrix, scale=2.0, translation=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(moved.means, 2.0 * capture.means @ turn.T + [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose(covariances(moved), 4.0 * turn @ covariances(capture) @ turn.T, atol=1e-6)
    np.testing.assert_allclose(present(moved.normals), normals @ turn.T, atol=1e-6)
    assert moved.opacities is capture.opacities and moved.roughness is capture.roughness
    assert moved.comments == ("kept",)


def covariances(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns covariances, shape (N, 3, 3)."""
    axes = np.stack([rotation_matrix(q) for q in gaussians.rotations_wxyz]) * gaussians.scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_transform_applies_scale_before_rotation_before_translation() -> None:
    """Scale, rotation and translation apply in this order, after the matrix."""
    capture = random_gaussians(1, count=5)
    together = ls.transform(capture, scale=2.0, rotation_degrees=(0, 90, 0), translation=(1, 0, 0))
    x, y, z = capture.means.T
    np.testing.assert_allclose(together.means, np.column_stack([2 * z + 1, 2 * y, -2 * x]), atol=1e-5)
    expected = quaternions_from_matrices(rotation((0, 1, 0), np.pi / 2)[None, :3, :3])[0]
    turned = ls.transform(
        ls.Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [1], np.zeros((1, 1, 3))), rotation_degrees=(0, 90, 0)
    )
    np.testing.assert_allclose(np.abs(turned.rotations_wxyz[0] @ expected), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0.0}, "scale is 0.0, expected a number above 0"),
        ({"scale": 1e-60}, "scales"),
        ({"rotation_degrees": (0, 0)}, "rotation_degrees is"),
        ({"translation": (0, np.inf, 0)}, "translation is"),
        ({"matrix": np.diag([1.0, 1.0, -1.0, 1.0])}, "matrix mirrors .*: transform takes rotation, uniform scale"),
        ({"matrix": np.diag([1.0, 1.0, 2.0, 1.0])}, "matrix scales the axes by 1, 1 and 2"),
        ({"matrix": np.zeros((3, 3))}, r"matrix has shape \(3, 3\)"),
    ],
)
def test_transform_refuses_matrices_that_shear_mirror_or_flatten(arguments: dict[str, Any], message: str) -> None:
    """Transforms that would shear, mirror or flatten Gaussians are refused by name."""
    with pytest.raises(ls.SceneError, match=message):
        ls.transform(random_gaussians(1, count=3), **arguments)
