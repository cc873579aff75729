"""Tests of unscented projections through lenses, against float64 and closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.splat.ray_bounds import ImageMoments, WorldGaussian
from lumisplat.renderer.scene.camera_table import image_field
from lumisplat.runtime.struct_tables import table_dtype
from support.oracles.raster_oracle import rotation_from_quaternion
from support.oracles.unscented_oracle import image_point, rays_of, sigma_moments
from support.probes import probe_unscented_kernels as probes
from support.scenes.gi_surfaces import camera_rows
from support.scenes.lenses import FISHEYE, LENSES, lens, rolling

STILL = [name for name, camera in LENSES.items() if camera.camera_from_world_end is None]


def moments_of(camera: ls.Camera, points: np.ndarray, axes: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Returns the image moments of Gaussians as rows of ``ImageMoments``; means are relative to the eye."""
    gaussians = wp.zeros(len(points), dtype=WorldGaussian, device="cpu")
    rows = np.zeros(len(points), table_dtype(WorldGaussian))
    rows["point"], rows["axes"], rows["scale"] = points, axes, scales
    gaussians.assign(rows)
    moments = wp.zeros(len(points), dtype=ImageMoments, device="cpu")
    inputs = [image_field(camera), camera_rows(camera), gaussians, moments]
    wp.launch(probes.probe_moments, len(points), inputs, device="cpu")
    return moments.numpy()


def pixels_of(camera: ls.Camera, points: np.ndarray) -> np.ndarray:
    """Projects N points relative to the eye; returns x, y and the change of the last iteration, shape (N, 3)."""
    found = wp.zeros(len(points), dtype=wp.vec3, device="cpu")
    given = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    wp.launch(probes.probe_points, len(points), [image_field(camera), camera_rows(camera), given, found], device="cpu")
    return found.numpy()


def gaussians_in_view(camera: ls.Camera, seed: int, count: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns small Gaussians inside the image: means relative to the eye, axes and scales."""
    rng = np.random.default_rng(seed)
    rays = camera.ray_directions().reshape(-1, 3)
    rays = rays[np.any(rays, axis=-1)][rng.integers(0, np.any(rays, axis=-1).sum(), count)]
    distances = rng.uniform(1.0, 5.0, count)
    points = distances[:, None] * rays @ camera.world_from_camera[:3, :3].T
    axes = rotation_from_quaternion((q := rng.normal(size=(count, 4))) / np.linalg.norm(q, axis=1, keepdims=True))
    return points, axes, distances[:, None] * np.exp(rng.uniform(-7.0, -5.0, (count, 3)))


@pytest.mark.parametrize("spread", [(1.0, 2.0, 0.0), (0.1, 2.0, 0.0), (1.0, 0.0, 1.0), (0.5, 2.0, -1.0)])
def test_oracle_of_the_unscented_transform_is_exact_for_linear_maps(spread: tuple[float, float, float]) -> None:
    """The moments are exact for every spread of the sigma points, even if the weight of the mean is negative."""
    rng = np.random.default_rng(1)
    matrix, offset = rng.normal(size=(2, 3)), rng.normal(size=2)
    axes = rotation_from_quaternion((q := rng.normal(size=(1, 4))) / np.linalg.norm(q))[0]
    mean, scales = rng.normal(size=3), rng.uniform(0.1, 2.0, 3)
    center, covariance = sigma_moments(lambda point: matrix @ point + offset, mean, axes, scales, spread)
    np.testing.assert_allclose(center, matrix @ mean + offset, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(covariance, matrix @ (axes * scales**2) @ axes.T @ matrix.T, rtol=1e-8, atol=1e-10)


def test_unscented_projection_of_disks_facing_a_pinhole_camera_is_exact() -> None:
    """Disks perpendicular to the optical axis have constant depth, so their projection is linear."""
    camera = replace(lens(45.0), camera_from_world=np.eye(4))
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (50, 2)), rng.uniform(2.0, 5.0, 50)])
    angle = rng.uniform(0.0, 6.0, 50)
    axes = np.zeros((50, 3, 3))
    axes[:, 0, 0], axes[:, 0, 1] = np.cos(angle), -np.sin(angle)
    axes[:, 1, 0], axes[:, 1, 1], axes[:, 2, 2] = np.sin(angle), np.cos(angle), 1.0
    scales = np.column_stack([rng.uniform(0.01, 0.5, (50, 2)), np.zeros(50)])
    found = moments_of(camera, points, axes, scales)
    focal = np.array([camera.fx, camera.fy])
    spread = (axes * scales[:, None])[:, :2] * focal[:, None] / points[:, 2:, None]
    covariance = spread @ spread.transpose(0, 2, 1)
    np.testing.assert_allclose(found["mean"], points[:, :2] / points[:, 2:] * focal + (camera.cx, camera.cy), atol=2e-4)
    for name, (i, j) in {"xx": (0, 0), "xy": (0, 1), "yy": (1, 1)}.items():
        np.testing.assert_allclose(found[name], covariance[:, i, j], rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", STILL)
def test_unscented_projection_matches_the_float64_oracle_for_every_lens(name: str) -> None:
    """Means and covariances of projected Gaussians are compared for every lens."""
    camera = LENSES[name]
    points, axes, scales = gaussians_in_view(camera, 3)
    found = moments_of(camera, points, axes, scales)
    camera_rotation = camera.camera_from_world[:3, :3]
    for k in range(len(points)):
        center, covariance = sigma_moments(
            lambda p: image_point(camera, camera_rotation @ p), points[k], axes[k], scales[k]
        )
        np.testing.assert_allclose(found["mean"][k], center, atol=1e-3)
        np.testing.assert_allclose(found["xx"][k], covariance[0, 0], rtol=2e-2, atol=1e-4)
        np.testing.assert_allclose(found["yy"][k], covariance[1, 1], rtol=2e-2, atol=1e-4)


@pytest.mark.parametrize("name", STILL)
def test_projection_by_each_lens_inverts_the_rays_of_its_pixels(name: str) -> None:
    """Points on a pixel's ray project back to the pixel's centre."""
    camera = LENSES[name]
    rays = camera.ray_directions()
    rows, columns = np.nonzero(np.any(rays, axis=-1) & (rays[..., 2] > -0.999))
    found = pixels_of(camera, 3.0 * rays[rows, columns] @ camera.world_from_camera[:3, :3].T)
    expected = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    near_fold = 2e-2 if name == "fold" else 2e-3
    np.testing.assert_allclose(found[:, :2], expected, atol=near_fold)


@pytest.mark.parametrize(
    "camera", [rolling(lens(45.0)), rolling(lens(18.0, model=FISHEYE))], ids=["pinhole", "fisheye"]
)
def test_rolling_shutter_projection_inverts_the_rays_of_each_row(camera: ls.Camera) -> None:
    """Points at any distance on the rays of a row project to this row, although rows differ in pose."""
    rays = rays_of(camera)
    rng = np.random.default_rng(4)
    y, x = rng.integers(0, camera.height, 300), rng.integers(0, camera.width, 300)
    points = rays.origin[y, x] + rng.uniform(1.0, 6.0, (300, 1)) * rays.direction[y, x]
    found = pixels_of(camera, points - camera.eye)
    np.testing.assert_allclose(found[:, :2], np.stack([x + 0.5, y + 0.5], axis=-1), atol=5e-3)
    assert found[:, 2].max() < 5e-3


@pytest.mark.parametrize("name", STILL)
def test_points_outside_the_view_of_a_lens_do_not_project_into_the_image(name: str) -> None:
    """The points lie behind a pinhole, beside the image, or beyond the monotonic radius of a lens."""
    camera = LENSES[name]
    rng = np.random.default_rng(5)
    random_directions = rng.normal(size=(4000, 3))
    random_directions /= np.linalg.norm(random_directions, axis=1, keepdims=True)
    rays = camera.ray_directions().reshape(-1, 3)
    rays = rays[np.any(rays, axis=-1)]
    nearest = np.array([(rays @ direction).max() for direction in random_directions])
    invisible = random_directions[nearest < np.cos(0.2)]
    if not len(invisible):
        pytest.skip("this lens has no invisible directions")
    found = pixels_of(camera, invisible @ camera.world_from_camera[:3, :3].T)
    in_image = np.isin(np.floor(found[:, 0]), range(camera.width)) & np.isin(
        np.floor(found[:, 1]), range(camera.height)
    )
    directions = camera.ray_directions()[
        np.clip(found[in_image, 1], 0, camera.height - 1).astype(int),
        np.clip(found[in_image, 0], 0, camera.width - 1).astype(int),
    ]
    assert not np.any(directions), "a point outside the view projects to a pixel that has a ray"
