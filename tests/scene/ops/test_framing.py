"""Cameras frame a scene from any side, relative to the scene's up."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.views import visible_bounds
from lumisplat.scene.scene import bulk_extent
from support.scenes.raster_scenes import quad, random_gaussians

SCENE = ls.Scene([random_gaussians(3, center=(5.0, -2.0, 9.0))])
CENTER = 0.5 * np.add(*visible_bounds(SCENE))
UPS = [*ls.Scene.UP_NAMES, (0.1, -0.9, 0.3)]


def placed(up: Any, **sides: float) -> tuple[np.ndarray, np.ndarray, ls.Camera]:
    """Returns up, the direction from the scene's centre to the eye, and the camera."""
    scene = ls.Scene(SCENE.splats, up=up)
    camera = ls.frame_camera(scene, distance=7.0, **cast(Any, sides))
    return np.array(scene.up_direction), (camera.eye - CENTER) / 7.0, camera


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("elevation", [-1.2, 0.0, 0.7])
def test_elevation_of_a_frame_camera_is_the_angle_above_the_horizon(up, elevation):
    """For any up, elevation is the angle of the eye above the horizon, and up stays up in the image."""
    upward, outward, camera = placed(up, azimuth=0.4, elevation=elevation)
    assert outward @ upward == pytest.approx(math.sin(elevation))
    assert camera.camera_from_world[1, :3] @ upward < -0.1
    assert camera.camera_from_world[0, :3] @ upward == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("up", UPS)
def test_increasing_azimuth_moves_a_frame_camera_to_the_right_around_the_scene(up):
    """A quarter turn moves the eye to the front camera's right, and a full turn back to the front."""
    _, _, front = placed(up, elevation=0.0)
    _, right, _ = placed(up, azimuth=0.5 * math.pi, elevation=0.0)
    np.testing.assert_allclose(right, front.camera_from_world[0, :3], atol=1e-12)
    _, again, _ = placed(up, azimuth=2.0 * math.pi, elevation=0.0)
    np.testing.assert_allclose(again, -front.camera_from_world[2, :3], atol=1e-12)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_frame_camera_straight_above_or_below_is_oriented_like_one_close_to_it(side):
    """Views from straight above and below have the orientation of views close to the pole."""
    _, outward, pole = placed("y-up", azimuth=0.3, elevation=0.5 * math.pi * side)
    assert abs(outward[1]) == pytest.approx(1.0)
    _, _, near = placed("y-up", azimuth=0.3, elevation=(0.5 * math.pi - 0.01) * side)
    np.testing.assert_allclose(pole.camera_from_world[:3, :3], near.camera_from_world[:3, :3], atol=0.011)


def test_frame_camera_centres_a_given_target():
    """A given target is at the centre of the image."""
    target = CENTER + np.array((0.5, 0.2, -0.1))
    camera = ls.frame_camera(SCENE, target=target, azimuth=1.0)
    x, y, z = camera.camera_from_world[:3, :3] @ target + camera.camera_from_world[:3, 3]
    assert (x, y) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.0, abs=1e-9)) and z > 0.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"azimuth": 30.0}, r"azimuth is 30.0, expected radians .*math.radians\(30\)"),
        ({"elevation": 2.0}, "elevation is 2.0, expected radians"),
        ({"distance": 0.0}, "distance is 0.0, expected a number above 0"),
        ({"target": (0, 1)}, "target is .*three finite numbers"),
        ({"fov_y": 45.0}, "fov_y is 45.0, expected radians"),
        ({"azimuth": math.nan}, "azimuth is nan"),
    ],
)
def test_frame_camera_refuses_invalid_arguments_such_as_angles_in_degrees(arguments, message):
    """Invalid values are refused, above all angles in degrees."""
    with pytest.raises(ls.SceneError, match=message):
        ls.frame_camera(SCENE, **arguments)


@pytest.mark.parametrize("up", ["sideways", (0, 0, 0), (1, 2), (math.inf, 0, 0)])
def test_scene_refuses_an_up_direction_that_is_no_direction(up):
    """A scene refuses an up that is not a direction."""
    with pytest.raises(ls.SceneError, match="up is"):
        ls.Scene(up=up)


def test_y_up_model_made_upright_looks_the_same_to_frame_camera_for_any_up_direction():
    """A y-up model rotated by `Scene.upright_wxyz` looks as in a y-up scene."""
    from lumisplat.math.transforms import rotation_matrix

    mesh = ls.Mesh([(0, 0, 0), (1, 0, 0), (0, 2, 0)], [(0, 1, 2)])
    alone = ls.frame_camera(ls.Scene([], [mesh]))
    for up in UPS:
        scene = ls.Scene(up=up)
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(scene.upright_wxyz)
        turned = ls.frame_camera(ls.Scene([], [ls.MeshInstance(mesh, pose)], up=up), target=pose[:3, :3] @ (0.5, 1, 0))
        np.testing.assert_allclose(
            turned.camera_from_world[:3, :3] @ pose[:3, :3], alone.camera_from_world[:3, :3], atol=1e-12
        )


def test_default_up_direction_is_minus_y_with_captures_and_plus_y_with_meshes_alone():
    """Captures are y down, meshes alone y up, unless the scene states its up."""
    assert SCENE.up_direction == (0.0, -1.0, 0.0)
    assert ls.Scene([], [quad(1.0)]).up_direction == (0.0, 1.0, 0.0)
    assert ls.Scene(SCENE.splats, up=(0, 0, 2)).up_direction == (0.0, 0.0, 1.0)


def seen(camera: ls.Camera, points: np.ndarray) -> bool:
    """Returns True if all points are in the image."""
    x, y, z = camera.camera_from_world[:3, :3] @ points.T + camera.camera_from_world[:3, 3:]
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return bool((z > 0).all() and (abs(u - 640) <= 640).all() and (abs(v - 360) <= 360).all())


def test_every_camera_of_an_orbit_shows_the_whole_scene():
    """Every camera of an orbit shows all corners of a long scene; at the front camera's distance, some are cut."""
    long = ls.Scene([random_gaussians(4, extent=(0.3, 0.2, 4.0), center=(1, 2, 3))])
    low, high = long.bulk_bounds()
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(3, -1).T
    cameras = ls.orbit_cameras(long, 24)
    assert all(seen(camera, corners) for camera in cameras)
    near = ls.orbit_cameras(long, 24, ls.frame_camera(long))
    assert not all(seen(camera, corners) for camera in near)


@pytest.mark.parametrize("up", UPS)
def test_orbit_cameras_equal_frame_cameras_at_evenly_spaced_azimuths(up):
    """Camera k of n has azimuth 2 pi k / n; fractional and negative turns scale the angle."""
    scene = ls.Scene(SCENE.splats, up=up)
    start = ls.frame_camera(scene, distance=5.0)
    for k, camera in enumerate(ls.orbit_cameras(scene, 5, start)):
        expected = ls.frame_camera(scene, azimuth=2.0 * math.pi * k / 5, distance=5.0)
        np.testing.assert_allclose(camera.camera_from_world, expected.camera_from_world, atol=1e-9)
    back = ls.orbit_cameras(scene, 5, start, turns=-1.0)
    there = ls.orbit_cameras(scene, 5, start)
    np.testing.assert_allclose(back[1].camera_from_world, there[4].camera_from_world, atol=1e-9)
    np.testing.assert_allclose(
        ls.orbit_cameras(scene, 2, start, turns=0.4)[1].camera_from_world, there[1].camera_from_world, atol=1e-9
    )


def test_orbit_around_a_point_keeps_the_distance_of_the_first_camera():
    """An orbit around a point keeps the distance and all other settings of the first camera."""
    first = ls.Camera.look_at((5, -3, 4), (5, -2, 9), (0, -1, 0), aperture=0.1, fov_y=0.5, width=64, height=48)
    for camera in ls.orbit_cameras(SCENE, 7, first, target=(4, -2, 8)):
        assert np.linalg.norm(camera.eye - (4, -2, 8)) == pytest.approx(np.linalg.norm(first.eye - (4, -2, 8)))
        assert (camera.aperture, camera.fx, camera.width) == (first.aperture, first.fx, 64)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"count": 0}, "count is 0"),
        ({"count": 4, "turns": math.inf}, "turns is inf"),
        ({"count": 4, "target": "here"}, "target is here"),
        ({"count": 4, "camera": "front"}, "orbit_cameras takes a Camera"),
    ],
)
def test_orbit_cameras_refuses_invalid_arguments_with_a_one_line_error(arguments, message):
    """The error is one line."""
    with pytest.raises(ls.SceneError, match=message):
        ls.orbit_cameras(SCENE, **arguments)


@pytest.mark.parametrize("spread", [0.0, 1.0, 1e6])
@pytest.mark.parametrize("count", [1, 2, 50, 5000])
def test_bounds_for_framing_exclude_2_percent_of_the_opacity_at_each_end(count, spread):
    """The bounds equal those by sorting to the bit, even with equal heights and distant outliers."""
    rng = np.random.default_rng(count)
    heights = np.round(rng.standard_cauchy(count), 1) * spread
    weights = rng.uniform(0.0, 1.0, count).astype(np.float32)
    order = np.argsort(heights)
    share = np.cumsum(weights[order], dtype=np.float64)
    ends = np.searchsorted(share, (0.02 * share[-1], 0.98 * share[-1]))
    assert bulk_extent(heights, weights) == tuple(heights[order[ends]])


def test_bounds_for_framing_move_with_a_moved_instance_although_they_are_cached():
    """The bulk of a moved instance moves with it, although bounds are cached."""
    capture = SCENE.splats[0].gaussians
    low, high = ls.Scene([ls.SplatInstance(capture)]).bulk_bounds()
    for shift in (1.0, 0.0, 2.0):
        moved = ls.Scene([ls.SplatInstance(capture, position=(shift, 0.0, 0.0))]).bulk_bounds()
        np.testing.assert_allclose(np.subtract(moved, (low, high)), [[shift, 0.0, 0.0]] * 2, atol=1e-12)


VIEW = ls.Camera.look_at((4.0, 1.0, -3.0), (5.0, -2.0, 9.0), (0.1, -1.0, 0.0), width=90, height=160, fov_y=1.1)


def viewed(up: Any = None, view: ls.Camera = VIEW) -> ls.Scene:
    """Returns a scene with a capture that states a first view."""
    return ls.Scene([replace(SCENE.splats[0].gaussians, first_view=view)], up=up)


def test_frame_camera_has_the_position_and_direction_of_the_first_view_without_its_roll():
    """The camera has the first view's eye and direction, and the scene's up without roll."""
    scene = viewed("y-down")
    camera = ls.frame_camera(scene)
    np.testing.assert_allclose(camera.eye, VIEW.eye)
    np.testing.assert_allclose(camera.camera_from_world[2], VIEW.camera_from_world[2], atol=1e-12)
    assert camera.camera_from_world[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert camera.camera_from_world[1, 1] > 0.9
    assert camera.fov_y == pytest.approx(1.1)  # the height of a portrait view fits into a wide frame
    assert camera.focus_distance == pytest.approx(VIEW.focus_distance)


def test_frame_camera_for_a_narrow_image_shows_the_whole_width_of_the_first_view():
    """In a narrower frame, the field of view grows until the first view's width fits."""
    camera = ls.frame_camera(viewed("y-down"), width=45, height=160)
    across = math.tan(0.5 * camera.fov_y) * 45 / 160
    assert across == pytest.approx(math.tan(0.55) * 90 / 160)


@pytest.mark.parametrize("up", UPS)
def test_azimuth_0_of_frame_camera_is_the_first_view_of_the_capture(up):
    """Azimuths start at the first view; distance, target and elevation default to the first view's."""
    scene = viewed(up)
    view, upward = ls.frame_camera(scene), np.array(scene.up_direction)
    turned = ls.frame_camera(scene, azimuth=math.pi)
    target = VIEW.eye + VIEW.focus_distance * VIEW.camera_from_world[2, :3]
    out, back = view.eye - target, turned.eye - target
    np.testing.assert_allclose(back + out, 2.0 * (out @ upward) * upward, atol=1e-9)
    near = ls.frame_camera(scene, distance=2.0)
    np.testing.assert_allclose(near.eye - target, 2.0 * out / np.linalg.norm(out), atol=1e-9)
    orbit = ls.orbit_cameras(scene, 4)
    np.testing.assert_allclose(orbit[0].eye, VIEW.eye, atol=1e-9)
    np.testing.assert_allclose(orbit[2].eye, turned.eye, atol=1e-9)


@pytest.mark.parametrize("height", [5.0, -5.0])
def test_frame_camera_keeps_the_roll_of_a_first_view_that_looks_straight_down_or_up(height):
    """The horizon is not defined for an aerial view, so the camera takes the view's own up."""
    view = ls.Camera.look_at((0.0, height, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 1.0))
    camera = ls.frame_camera(viewed("y-up", view))
    np.testing.assert_allclose(camera.camera_from_world, view.camera_from_world, atol=1e-9)


def pole(*more: np.ndarray) -> ls.Gaussians:
    """Returns a ball with a thin pole of 1 % of its Gaussians, and Gaussians at further means."""
    ball = np.random.default_rng(5).normal(size=(5000, 3)) * 0.3
    up = np.column_stack([np.zeros(50), np.linspace(-0.5, -2.5, 50), np.zeros(50)])
    means = np.concatenate([ball, up, *more])
    return ls.Gaussians(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        np.full((len(means), 3), 0.02),
        np.full(len(means), 0.9),
        np.zeros((len(means), 1, 3)),
    )


def test_frame_camera_shows_thin_parts_connected_to_the_scene_but_no_stray_gaussians():
    """A pole of 1 % of the opacity connects to the ball and is framed; floating strays do not widen the view."""
    strays = np.random.default_rng(6).uniform(-30.0, 30.0, (40, 3))
    without_strays, with_strays = (ls.frame_camera(ls.Scene([pole(*more)])) for more in ((), (strays,)))
    tip = without_strays.camera_from_world @ (0.0, -2.5, 0.0, 1.0)
    row = without_strays.cy + without_strays.fy * tip[1] / tip[2]
    assert 0.0 < row < 0.1 * without_strays.height
    assert with_strays.focus_distance == pytest.approx(without_strays.focus_distance, rel=0.05)
    low, high = ls.Scene([pole()]).bulk_bounds()
    assert low[1] > -1.0 and high[1] < 1.0  # the bulk excludes the pole


def test_frame_camera_ignores_small_parts_separated_from_the_scene_by_a_gap():
    """A second ball across a gap does not count unless it is part of the bulk."""
    other = np.array([0.0, -6.0, 0.0]) + np.random.default_rng(7).normal(size=(30, 3)) * 0.05
    with_gap = ls.frame_camera(ls.Scene([pole(other)]))
    assert with_gap.focus_distance == pytest.approx(ls.frame_camera(ls.Scene([pole()])).focus_distance, rel=0.05)
