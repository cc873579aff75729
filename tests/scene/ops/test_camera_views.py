"""Up and first view follow from the cameras of images, in any orientation of the world."""

from __future__ import annotations

import math

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.views import first_view_of, up_of_cameras
from support.kinds import present

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.3, -0.5, 0.8)]
SOME = np.random.default_rng(0).normal(size=(50, 3))


def turn_to(up: tuple[float, float, float]) -> np.ndarray:
    """Returns a rotation that takes z to a direction."""
    z = np.array(up) / np.linalg.norm(up)
    x = np.cross(z, (0.3, 0.9, 0.1))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def around(
    turn: np.ndarray, degrees: float = 360.0, *, below: float = 0.4, count: int = 24, roll: float = 0.05, side: int = 0
) -> list[ls.Camera]:
    """Returns rolled cameras on an arc that look down at a point; every ``side``-th one is in portrait orientation."""
    rng = np.random.default_rng(1)
    cameras: list[ls.Camera] = []
    for k in range(count):
        angle = math.radians(degrees) * k / count
        eye = 4.0 * np.array([math.cos(angle), math.sin(angle), math.tan(below)])
        right = np.array([-math.sin(angle), math.cos(angle), 0.0])
        lean = rng.normal() * roll + (math.pi / 2 if side and k % side == 0 else 0.0)
        up = math.cos(lean) * np.array([0.0, 0.0, 1.0]) + math.sin(lean) * right
        cameras.append(ls.Camera.look_at(turn @ (eye + 0.7), turn @ np.full(3, 0.7), turn @ up, width=30, height=40))
    return cameras


def tilt(found: tuple[float, float, float] | None, up: tuple[float, float, float]) -> float:
    """Returns the angle between two directions in degrees."""
    one = present(found)
    # The arc cosine knows small angles to 1e-6 degrees only.
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, up))), float(one @ np.array(up))))


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degrees", [360.0, 120.0, 60.0])
def test_up_direction_estimated_from_cameras_around_an_object_is_right_to_4_degrees(
    up: tuple[float, float, float], degrees: float
) -> None:
    """Up is found within 4 degrees, also from arcs where the mean of the cameras' ups leans."""
    turn = turn_to(up)
    assert tilt(up_of_cameras(around(turn, degrees)), up) < 4.0


def test_mean_of_the_up_vectors_of_cameras_on_an_arc_is_wrong_by_over_10_degrees() -> None:
    """On a third of a circle, looking down by 23 degrees, the mean up is off by more than 10 degrees."""
    cameras = around(np.eye(3), 120.0)
    mean = -np.mean([camera.camera_from_world[1, :3] for camera in cameras], axis=0)
    assert tilt(tuple(mean / np.linalg.norm(mean)), (0.0, 0.0, 1.0)) > 10.0


@pytest.mark.parametrize("up", UPS)
def test_images_in_portrait_orientation_do_not_change_the_estimated_up_direction(
    up: tuple[float, float, float],
) -> None:
    """A third of the images in portrait orientation does not change up."""
    assert tilt(up_of_cameras(around(turn_to(up), side=3)), up) < 4.0


@pytest.mark.parametrize("up", UPS)
def test_up_direction_estimated_from_aerial_cameras_is_opposite_to_their_view(up: tuple[float, float, float]) -> None:
    """For an aircraft flying back and forth, image ups cancel, so that up is opposite to the view."""
    turn = turn_to(up)
    flown = [
        ls.Camera.look_at(turn @ (x, y, 50.0), turn @ (x, y, 0.0), turn @ (0.0, 1.0 - 2.0 * (y % 2), 0.0))
        for y in range(4)
        for x in range(5)
    ]
    assert tilt(up_of_cameras(flown), up) < 1e-6


def test_no_up_direction_is_estimated_from_cameras_with_random_view_and_roll() -> None:
    """Cameras that look to all sides with any roll give no up."""
    everywhere = [ls.Camera.look_at((0, 0, 0), one, np.roll(one, 1)) for one in (*np.eye(3), *-np.eye(3))]
    assert up_of_cameras(everywhere) is None


@pytest.mark.parametrize("up", UPS)
def test_first_view_of_a_training_is_a_camera_focused_where_the_optical_axes_meet(
    up: tuple[float, float, float],
) -> None:
    """The first view has a camera's pose and lens, and focuses where the optical axes meet."""
    turn = turn_to(up)
    cameras = around(turn, 90.0)
    view = first_view_of(cameras, SOME)
    (own,) = [one for one in cameras if np.allclose(one.camera_from_world, view.camera_from_world, atol=1e-9)]
    assert (view.fov_y, view.width, view.height) == (pytest.approx(own.fov_y), 30, 40)
    target = view.eye + view.focus_distance * view.camera_from_world[2, :3]
    np.testing.assert_allclose(target, turn @ np.full(3, 0.7), atol=1e-6)
    angle = math.degrees(math.atan2(*(turn.T @ view.eye - 0.7)[[1, 0]]))
    assert 30.0 < angle < 60.0  # the middle of the arc


def test_first_view_of_a_training_with_parallel_cameras_focuses_on_the_surface_ahead() -> None:
    """If no optical axes meet, the depth at the image centre gives the focus distance."""
    cameras = [ls.Camera.look_at((x, 0.0, -5.0), (x, 0.0, 0.0), (0.0, -1.0, 0.0)) for x in (-1.0, 0.0, 1.0)]
    wall = np.column_stack([*np.meshgrid(np.linspace(-3, 3, 20), np.linspace(-3, 3, 20))]).reshape(-1, 2)
    view = first_view_of(cameras, np.column_stack([wall, np.full(len(wall), 2.0)]))
    np.testing.assert_allclose(view.eye, (0.0, 0.0, -5.0))
    assert view.focus_distance == pytest.approx(7.0)


@pytest.mark.parametrize("count", [1, 2])
def test_single_training_camera_is_enough_for_a_first_view_and_an_up_direction(count: int) -> None:
    """One image is enough for a first view and an up."""
    cameras = around(np.eye(3), count=count)
    assert up_of_cameras(cameras) is not None
    assert first_view_of(cameras, SOME).focus_distance > 0.0
