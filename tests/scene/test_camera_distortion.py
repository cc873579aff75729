"""Lens distortion follows OpenCV's published formulas and their inverse, and rays follow the distortion."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.distortion import distort, distortion_reach, undistort
from support.scenes.raster_scenes import front_camera

FOX = (0.0578421, -0.0805099, 0.0, 0.0, -0.000980296, 0.00015575)
"""Distortion of the phone camera of instant-ngp's fox data set."""
BARREL = (-0.28, 0.09, -0.012, 0.0, 0.0006, -0.0011)
"""Distortion of an action camera."""
CUSHION = (0.21, 0.03, 0.01, 0.002, 0.004, -0.003)
FISHEYE = (-0.013, 0.0021, -0.0009, 0.0001, 0.0, 0.0)
NONE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
LENSES = {"fox": FOX, "barrel": BARREL, "cushion": CUSHION, "fisheye": FISHEYE}


def opencv_pinhole(points: np.ndarray, k1, k2, k3, p1, p2) -> np.ndarray:
    """Returns x'' and y'' of OpenCV's camera calibration page, without the denominator and thin prisms."""
    x, y = points.T
    r = np.hypot(x, y)
    scale = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    return np.stack(
        [x * scale + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2), y * scale + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y], 1
    )


def opencv_fisheye(directions: np.ndarray, k1, k2, k3, k4) -> np.ndarray:
    """Returns x' and y' of OpenCV's fisheye page: theta_d / r times a and b."""
    a, b = directions[:, 0] / directions[:, 2], directions[:, 1] / directions[:, 2]
    r = np.hypot(a, b)
    theta = np.arctan(r)
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    return np.stack([bent / r * a, bent / r * b], 1)


def camera_of(lens, model=ls.CameraModel.PINHOLE, **changes) -> ls.Camera:
    """Returns a camera of 60 x 40 pixels whose corners are 47 degrees off the axis."""
    return front_camera(60, 40, 33.0, cx=29.0, cy=20.6, model=model, distortion=lens, **changes)


def shown_at(camera: ls.Camera) -> np.ndarray:
    """Returns the pixel centres relative to the principal point, divided by the focal length, shape (N, 2)."""
    y, x = np.mgrid[: camera.height, : camera.width]
    points = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy], axis=-1)
    return points.reshape(-1, 2)


@pytest.mark.parametrize("name", ["fox", "barrel"])
def test_pinhole_distortion_equals_the_formula_of_opencv(name):
    """Each pixel's ray, distorted by OpenCV's formula, projects to the pixel."""
    lens = LENSES[name]
    camera = camera_of(lens)
    rays = camera.ray_directions().reshape(-1, 3)
    k1, k2, k3, _, p1, p2 = lens
    np.testing.assert_allclose(
        opencv_pinhole(rays[:, :2] / rays[:, 2:], k1, k2, k3, p1, p2), shown_at(camera), atol=1e-9
    )


def test_fisheye_distortion_equals_the_polynomial_of_opencv():
    """Each pixel's ray, distorted by OpenCV's polynomial of the angle, projects to the pixel."""
    camera = camera_of(FISHEYE, ls.CameraModel.FISHEYE)
    rays = camera.ray_directions().reshape(-1, 3)
    np.testing.assert_allclose(opencv_fisheye(rays, *FISHEYE[:4]), shown_at(camera), atol=1e-9)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_lens_undistortion_inverts_distortion_in_both_directions(lens):
    """Distortion and undistortion are inverse in both directions, within the lens's range."""
    rng = np.random.default_rng(3)
    angle, radius = rng.uniform(0, 2 * np.pi, 500), rng.uniform(0, 0.9 * min(1.2, distortion_reach(lens)), 500)
    points = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    np.testing.assert_allclose(undistort(distort(points, lens), lens), points, atol=1e-9)


def test_pixels_beyond_the_fold_of_the_distortion_have_no_ray():
    """Beyond the fold of the polynomial, pixels have no ray, so that the centre does not reappear at the edge."""
    lens = (-0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    assert distortion_reach(lens) == pytest.approx(np.sqrt(1 / 1.5))
    largest = distort(np.array([[distortion_reach(lens), 0.0]]), lens)[0, 0]
    camera = camera_of(lens)
    shown = np.hypot(*shown_at(camera).T).reshape(40, 60)
    missing = (camera.ray_directions() == 0.0).all(axis=2)
    assert missing.any() and not missing.all()
    np.testing.assert_array_equal(missing, shown > largest)


def test_distortion_coefficients_of_zero_change_no_bits():
    """Rays equal those without distortion, and the camera does not count as distorted."""
    np.testing.assert_array_equal(camera_of(NONE).ray_directions(), camera_of([0] * 6).ray_directions())
    assert not camera_of(NONE).is_distorted
    assert distortion_reach(NONE) == np.inf


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distortion": (0.1, 0.2)}, "camera distortion is .*expected six finite numbers"),
        ({"distortion": (np.nan,) * 6}, "expected six finite numbers"),
        ({"distortion": FOX, "model": ls.CameraModel.ORTHOGRAPHIC}, "this one is orthographic"),
    ],
)
def test_camera_refuses_invalid_distortion_coefficients(changes, message):
    """The error is one line."""
    with pytest.raises(ls.SceneError, match=message):
        front_camera(**changes)


def test_lens_distortion_does_not_depend_on_the_image_size():
    """Coefficients apply to tangents of view angles, not to pixels."""
    small, large = camera_of(BARREL).scaled(30, 20), camera_of(BARREL)
    corner = 0.25 * (large.ray_directions()[0, 0] + large.ray_directions()[1, 1])
    corner += 0.25 * (large.ray_directions()[0, 1] + large.ray_directions()[1, 0])
    np.testing.assert_allclose(small.ray_directions()[0, 0], corner / np.linalg.norm(corner), atol=2e-3)


def test_distorting_points_near_the_camera_plane_overflows_without_a_warning() -> None:
    """Points nearly in the camera's plane become non-finite, without a warning of NumPy."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shown = distort(np.array([[1e160, 1e160], [0.1, 0.2]]), (0.1, -0.3, 0.0, 1e8, 0.1, 0.0))
        camera_reach = distortion_reach((1e9, -1e9, 1e-29, 1e-29, 0.0, 0.0))
    assert not np.isfinite(shown[0]).any() and np.isfinite(shown[1]).all() and camera_reach > 0.0
