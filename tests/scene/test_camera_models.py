"""Fisheye, orthographic and thin-lens cameras and rolling shutters are validated, and rays equal closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls
from lumisplat.renderer.scene.camera_table import refuse_lens
from support.oracles.camera_oracle import camera_rays
from support.scenes.raster_scenes import front_camera, one_gaussian, rotation

FISHEYE, ORTHOGRAPHIC = ls.CameraModel.FISHEYE, ls.CameraModel.ORTHOGRAPHIC


def posed(turn: np.ndarray, eye: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Returns camera_from_world for a rotation and a position in the world."""
    world_from_camera = turn.copy()
    world_from_camera[:3, 3] = eye
    return np.linalg.inv(world_from_camera)


def test_pinhole_rays_pass_through_the_pixel_centres() -> None:
    """Rays have unit length, and pass through the pixel centres."""
    camera = front_camera(7, 5, fx=4.0, fy=5.0, cx=3.0, cy=2.0)
    rays = camera.ray_directions()
    assert rays.shape == (5, 7, 3) and rays.dtype == np.float64
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0)
    np.testing.assert_allclose(4.0 * rays[..., 0] / rays[..., 2] + 3.0, np.tile(np.arange(7) + 0.5, (5, 1)))
    np.testing.assert_allclose(5.0 * rays[..., 1] / rays[..., 2] + 2.0, np.tile(np.arange(5)[:, None] + 0.5, 7))


def test_angle_of_a_fisheye_ray_is_proportional_to_the_distance_in_the_image() -> None:
    """At 220 degrees over 220 rows, a pixel 100 rows from the centre has a ray 100 degrees off the axis."""
    camera = ls.Camera.look_at((0, 0, 0), (0, 0, 1), width=221, height=221, fov_y=np.radians(221.0), model=FISHEYE)
    rays = camera.ray_directions()
    assert camera.fov_y == pytest.approx(np.radians(221.0))
    np.testing.assert_allclose(rays[110, 110], (0.0, 0.0, 1.0), atol=1e-12)
    angle = np.radians(100.0)
    np.testing.assert_allclose(rays[110, 210], (np.sin(angle), 0.0, np.cos(angle)), atol=1e-12)
    np.testing.assert_allclose(rays[10, 110], (0.0, -np.sin(angle), np.cos(angle)), atol=1e-12)
    diagonal = np.radians(60.0 * np.sqrt(2.0))
    side = np.sin(diagonal) * np.sqrt(0.5)
    np.testing.assert_allclose(rays[170, 50], (-side, side, np.cos(diagonal)), atol=1e-12)


def test_fisheye_pixels_beyond_180_degrees_off_axis_have_no_ray() -> None:
    """At 360 degrees over the height, corners beyond theta = pi have no ray; all other pixels have a unit ray."""
    camera = ls.Camera.look_at((0, 0, 0), (0, 0, 1), width=64, height=64, fov_y=2.0 * np.pi, model=FISHEYE)
    rays = camera.ray_directions()
    y, x = np.mgrid[:64, :64] + 0.5 - 32.0
    outside = np.hypot(x, y) > 32.0
    assert outside[0, 0] and not outside[0, 32]
    np.testing.assert_array_equal(rays[outside], 0.0)
    np.testing.assert_allclose(np.linalg.norm(rays[~outside], axis=-1), 1.0)


def test_rays_of_an_orthographic_camera_are_parallel() -> None:
    """All rays are parallel to the axis; look_at covers as much as a pinhole camera would at the target."""
    arguments = {"eye": (0, 0, -4), "target": (0, 0, 0), "width": 30, "height": 20, "fov_y": 0.9}
    camera = ls.Camera.look_at(**arguments, model=ORTHOGRAPHIC)
    np.testing.assert_array_equal(camera.ray_directions(), np.broadcast_to((0.0, 0.0, 1.0), (20, 30, 3)))
    pinhole = ls.Camera.look_at(**arguments)
    assert camera.fx == camera.fy == pytest.approx(pinhole.fx / 4.0)
    assert camera.fov_y == 0.0


@pytest.mark.parametrize("model", list(ls.CameraModel))
def test_ray_of_a_pixel_is_that_of_the_definitions_also_with_a_rolling_shutter(model: ls.CameraModel) -> None:
    """Origin and direction in the world equal those of the model, at the pose in which the pixel's row is exposed."""
    first, last = (posed(rotation((0.3, 1.0, 0.2), angle), (1.0, -2.0, angle)) for angle in (0.7, 0.9))
    camera = front_camera(40, 32, fx=26.0, fy=25.0, cx=19.0, cy=15.0, model=model)
    camera = replace(camera, camera_from_world=first, camera_from_world_end=last)
    origins, directions, _ = camera_rays(camera)
    for column, row in ((16, 16), (39, 20), (25, 31)):
        origin, along = ls.rays.pixel_ray(camera, column, row)
        np.testing.assert_allclose(origin[0], origins[row, column], atol=1e-9)
        np.testing.assert_allclose(along[0], directions[row, column], atol=1e-9)
    with pytest.raises(ls.SceneError, match="pixel y is 32, expected a whole number from 0 to 31"):
        ls.rays.pixel_ray(camera, 0, 32)


@pytest.mark.parametrize("model", list(ls.CameraModel))
def test_camera_method_scaled_keeps_the_view_for_every_camera_model(model: ls.CameraModel) -> None:
    """With twice as many pixels, the mean of four new rays equals the ray of the old pixel; lens and shutter stay."""
    end = posed(rotation((0.0, 1.0, 0.0), 0.1))
    camera = front_camera(
        8, 6, 5.0, model=model, cx=3.0, aperture=0.2, focus_distance=3.0, camera_from_world_end=end, near=0.5
    )
    double = camera.scaled(width=16)
    assert (double.width, double.height, double.fx, double.cx) == (16, 12, 10.0, 6.0)
    assert (double.model, double.aperture, double.focus_distance, double.near) == (model, 0.2, 3.0, 0.5)
    np.testing.assert_array_equal(double.camera_from_world_end, end)
    mean = double.ray_directions().reshape(6, 2, 8, 2, 3).mean(axis=(1, 3))
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    np.testing.assert_allclose(mean, camera.ray_directions(), atol=0.01)


def frame_of(camera: ls.Camera, depth: np.ndarray) -> ls.Frame:
    """Returns a frame with the given depth."""
    nothing = np.zeros(depth.shape, np.float32)
    color, index = np.zeros((*depth.shape, 3), np.float32), np.zeros(depth.shape, np.int32)
    return ls.Frame(color, nothing, depth.astype(np.float32), color, index, index, camera)


@pytest.mark.parametrize("model", list(ls.CameraModel))
def test_depth_z_of_a_plane_that_faces_the_camera_is_constant_for_any_camera_model(model: ls.CameraModel) -> None:
    """A plane at view depth 3 has depth_z 3 at every pixel, and behind a fisheye depth_z is negative."""
    camera = front_camera(24, 20, 6.0, model=model)
    z = camera.ray_directions()[..., 2]
    depth = np.full(z.shape, np.inf)
    np.divide(3.0, z, out=depth, where=z > 1e-3)
    behind = (z < -1e-3) & (model is FISHEYE)
    depth[behind] = 3.0 / -z[behind]
    depth[0, 0] = np.inf
    expected = np.where(np.isfinite(depth), np.where(behind, -3.0, 3.0), np.inf)
    assert behind.any() == (model is FISHEYE)
    depth_z = frame_of(camera, depth).depth_z
    assert depth_z.dtype == np.float32
    np.testing.assert_allclose(depth_z, expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "fish"}, "camera model is 'fish', expected 'pinhole', 'fisheye' or 'orthographic'"),
        ({"aperture": -0.1}, "camera aperture is -0.1, expected a number at least 0"),
        ({"aperture": np.nan}, "camera aperture is nan, expected a number at least 0"),
        ({"exposure": np.nan}, "camera exposure is nan, expected -100.0 to 100.0"),
        ({"exposure": 2000.0}, "camera exposure is 2000.0, expected -100.0 to 100.0"),
        ({"focus_distance": 0.0}, "camera focus_distance is 0.0, expected a number above 0"),
        ({"focus_distance": "far"}, "camera focus_distance is 'far', expected a number above 0"),
        ({"focus_distance": np.inf}, "camera focus_distance is inf, expected a number above 0"),
        ({"camera_from_world_end": np.eye(3)}, r"camera_from_world_end has shape \(3, 3\), expected \(4, 4\)"),
        ({"camera_from_world_end": 2.0 * np.eye(4)}, "camera_from_world_end has last row"),
        ({"camera_from_world_end": np.diag([2.0, 2.0, 2.0, 1.0])}, "camera_from_world_end is not rigid"),
        ({"camera_from_world_end": np.diag([-1.0, 1.0, -1.0, 1.0])}, "rotated by 180 degrees from camera_from_world"),
    ],
)
def test_error_for_an_invalid_lens_or_shutter_of_a_camera_names_the_value(
    changes: dict[str, Any], message: str
) -> None:
    """The error names the value and what was expected, in one line."""
    with pytest.raises(ls.SceneError, match=message) as raised:
        front_camera(**changes)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("model", "fov_y", "message"),
    [
        (FISHEYE, 6.3, "fov_y is 6.3, expected radians between 0 and 2 pi"),
        (FISHEYE, 0.0, "fov_y is 0.0, expected radians between 0 and 2 pi"),
        (ORTHOGRAPHIC, 3.2, "fov_y is 3.2, expected radians between 0 and pi"),
    ],
)
def test_camera_look_at_refuses_fields_of_view_impossible_for_its_camera_model(
    model: ls.CameraModel, fov_y: float, message: str
) -> None:
    """A fisheye's field of view is at most a full turn."""
    with pytest.raises(ls.SceneError, match=message):
        ls.Camera.look_at((0, 0, 0), (0, 0, 1), fov_y=fov_y, model=model)


def test_camera_look_at_focuses_on_its_target_by_default() -> None:
    """The default focus distance is that of the target."""
    camera = ls.Camera.look_at((1, 2, 3), (1, 2, 8), aperture=0.25)
    assert (camera.aperture, camera.focus_distance) == (0.25, 5.0)
    assert ls.Camera.look_at((1, 2, 3), (1, 2, 8), aperture=0.25, focus_distance=2.0).focus_distance == 2.0


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.floats(-3.0, 3.0), st.floats(0.0, 6.0))
def test_shutter_rotation_and_motion_take_a_camera_from_its_first_to_its_last_pose(
    axis: tuple[float, float, float], angle: float, start: float
) -> None:
    """The first pose rotated by ``shutter_rotation`` is the last one, and the eye moves by ``shutter_motion``."""
    if np.linalg.norm(axis) < 0.1:
        return
    first = rotation((0.3, -0.5, 0.8), start)
    camera = front_camera(
        camera_from_world=posed(first, (1.0, 2.0, 3.0)),
        camera_from_world_end=posed(rotation(axis, angle) @ first, (1.5, 2.0, 2.0)),
    )
    expected = np.asarray(axis) / np.linalg.norm(axis) * angle
    np.testing.assert_allclose(camera.shutter_rotation, expected, atol=1e-9)
    np.testing.assert_allclose(camera.shutter_motion, (0.5, 0.0, -1.0), atol=1e-12)


def test_camera_with_equal_or_no_end_pose_has_no_shutter_motion() -> None:
    """``shutter_rotation`` and ``shutter_motion`` are exactly zero."""
    pose = posed(rotation((0.3, -0.5, 0.8), 1.234), (0.1, 0.2, 0.3))
    for end in (None, pose):
        camera = front_camera(camera_from_world=pose, camera_from_world_end=end)
        np.testing.assert_array_equal(camera.shutter_rotation, 0.0)
        np.testing.assert_array_equal(camera.shutter_motion, 0.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"model": FISHEYE},
            r"camera 'left' is fisheye, which Pipeline\.RASTER cannot draw: use Projection\.UNSCENTED or",
        ),
        ({"model": ORTHOGRAPHIC, "name": ""}, "^camera is orthographic, which"),
        ({"aperture": 0.1}, "has an aperture of 0.1"),
        ({"camera_from_world_end": np.eye(4)}, "has a rolling shutter"),
    ],
)
def test_raster_and_realtime_refuse_camera_features_they_do_not_support(changes: dict[str, Any], message: str) -> None:
    """The error names the feature, and the pipeline that supports it."""
    camera = front_camera(name="left")
    refuse_lens(camera, ls.Pipeline.RASTER)
    with pytest.raises(ls.SceneError, match=message):
        refuse_lens(replace(camera, **changes), ls.Pipeline.RASTER)
    with pytest.raises(ls.SceneError, match=r"which Pipeline\.REALTIME cannot draw: use Pipeline\.PATH"):
        refuse_lens(replace(camera, **changes), ls.Pipeline.REALTIME)
    if changes.get("model") is FISHEYE or "camera_from_world_end" in changes:
        refuse_lens(replace(camera, **changes), ls.Pipeline.RASTER, ls.config.Projection.UNSCENTED)


def test_depth_z_of_a_rasterised_flat_gaussian_facing_the_camera_is_constant() -> None:
    """A flat Gaussian off the axis, facing the camera, has the same depth_z at all its pixels."""
    scene = ls.Scene([one_gaussian((0.9, -0.7, 3.0), (0.3, 0.3, 1e-4), 0.9)])
    frame = ls.render(scene, front_camera(), device="cpu")
    found = np.isfinite(frame.depth)
    assert found.any()
    np.testing.assert_allclose(frame.depth_z[found], 3.0, rtol=1e-5)
