"""Undistortion of images of distorted lenses, compared with pinhole rays into a distant analytic environment."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.io.training_images.loading import lens_points
from support.files.training_image_files import render_image, ring_cameras, write_nerfstudio_images

FISHEYE = ls.CameraModel.FISHEYE
LENSES: dict[str, dict[str, Any]] = {
    "strong phone": {"fx": 80.0, "fy": 81.0, "distortion": (0.232, -0.322, 0.0, 0.0, -0.0039, 0.0006)},
    "barrel": {"fx": 80.0, "fy": 81.0, "distortion": (-0.28, 0.09, -0.012, 0.0, 0.0006, -0.0011)},
    "cushion": {"fx": 80.0, "fy": 81.0, "distortion": (0.21, 0.03, 0.01, 0.0, 0.004, -0.003)},
    "fisheye": {"model": FISHEYE, "fx": 70.0, "fy": 71.0},
    "bent fisheye": {"model": FISHEYE, "fx": 70.0, "fy": 71.0, "distortion": (0.05, -0.01, 0.004, -0.001, 0.0, 0.0)},
}


@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_training_image_undistorted_from_any_lens_equals_a_pinhole_image(tmp_path, lens, scale):
    """An image rendered through the lens and undistorted equals an image of the pinhole to a few bytes."""
    cameras = ring_cameras(2, 120, 90, **lens)
    folder = write_nerfstudio_images(tmp_path, cameras, [_large(camera) for camera in cameras])
    for view in ls.io.load_training_images(folder, hold_out=0, scale=scale).training:
        assert view.camera.model is ls.CameraModel.PINHOLE and not view.camera.is_distorted
        mask = view.mask()
        counts = np.ones(view.pixels().shape[:2], bool) if mask is None else mask > 0.0
        assert counts.mean() > 0.7
        error = np.abs(view.pixels() - render_image(view.camera))[counts]
        assert error.max() < 4.0 / 255.0 / scale and error.mean() < 0.6 / 255.0
        assert not view.pixels()[~counts].any()
        # Without undistortion the error is large, so the test is sensitive to it.
        assert np.abs(render_image(cameras[0]) - render_image(_pinhole(cameras[0]))).max() > 3.0 * error.max()


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistortion_maps_each_pinhole_pixel_to_the_lens_point_of_the_same_ray(lens):
    """`lens_points` maps a pinhole pixel to a point of the lens image that has the same ray."""
    camera = ring_cameras(1, 60, 45, **lens)[0]
    points, covered = lens_points(camera)
    rays = _pinhole(camera).ray_directions()
    for row, column in ((0, 0), (22, 30), (44, 59), (10, 50)):
        if covered[row, column]:
            x, y = points[row, column]
            shifted = ls.Camera(
                width=1,
                height=1,
                fx=camera.fx,
                fy=camera.fy,
                cx=camera.cx - x + 0.5,
                cy=camera.cy - y + 0.5,
                camera_from_world=np.eye(4),
                model=camera.model,
                distortion=camera.distortion,
            )
            np.testing.assert_allclose(shifted.ray_directions()[0, 0], rays[row, column], atol=1e-9)


def test_undistorted_pixels_outside_the_lens_image_are_masked(tmp_path):
    """Corners of a pincushion lens are masked and black; a barrel lens covers all pixels."""
    masks = {}
    for name in ("cushion", "barrel"):
        folder = write_nerfstudio_images(
            tmp_path / name, ring_cameras(2, 60, 45, **LENSES[name] | {"fx": 40.0, "fy": 40.0})
        )
        masks[name] = ls.io.load_training_images(folder, hold_out=0).training[0].mask()
    assert masks["barrel"] is None
    cushion = masks["cushion"]
    assert cushion is not None and set(np.unique(cushion)) == {0.0, 1.0}
    assert cushion[0, 0] == cushion[-1, -1] == 0.0 and cushion[22, 30] == 1.0


def test_undistorted_pixels_beyond_the_distortion_fold_are_masked(tmp_path):
    """Beyond the fold of the distortion polynomial, no image position belongs to a ray."""
    folder = write_nerfstudio_images(
        tmp_path, ring_cameras(2, 120, 90, fx=60.0, fy=60.0, distortion=(-0.45, 0.0, 0.0, 0.0, 0.0, 0.0))
    )
    mask = ls.io.load_training_images(folder, hold_out=0).training[0].mask()
    assert mask is not None
    x, y = np.meshgrid(np.arange(120) + 0.5 - 60.7, np.arange(90) + 0.5 - 44.6)
    reach = 60.0 * np.sqrt(1.0 / (3.0 * 0.45))
    np.testing.assert_array_equal(mask > 0.0, np.hypot(x, y) <= reach)


def _pinhole(camera: ls.Camera) -> ls.Camera:
    from lumisplat.io.training_images.loading import pinhole_of

    return pinhole_of(camera)


def _large(camera: ls.Camera) -> np.ndarray:
    """Returns the analytic image of a camera; pixels without a ray are grey."""
    image = render_image(camera)
    image[~camera.ray_directions().any(axis=-1)] = 0.5
    return image
