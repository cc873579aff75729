"""Up and first view from the cameras of images, in worlds turned any way."""

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
    """A rotation that turns z to a direction."""
    z = np.array(up) / np.linalg.norm(up)
    x = np.cross(z, (0.3, 0.9, 0.1))
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def around(
    turn: np.ndarray, degrees: float = 360.0, *, below: float = 0.4, count: int = 24, roll: float = 0.05, side: int = 0
) -> list[ls.Camera]:
    """Cameras on an arc that look down at a point, held with some roll; every ``side``-th one is held on its side."""
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
    """Degrees between two directions."""
    return math.degrees(math.acos(min(1.0, float(present(found) @ np.array(up)) / float(np.linalg.norm(up)))))


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("degrees", [360.0, 120.0, 60.0])
def test_up_is_that_of_people_who_walk_round_a_thing(up: tuple[float, float, float], degrees: float) -> None:
    """Also from one side, where the mean of the cameras' ups leans away from what all of them look down at."""
    turn = turn_to(up)
    assert tilt(up_of_cameras(around(turn, degrees)), up) < 4.0


def test_the_mean_alone_would_lean() -> None:
    """What least squares are for: from a third of a circle, looking down by 23 degrees, it is off by more than ten."""
    cameras = around(np.eye(3), 120.0)
    mean = -np.mean([camera.camera_from_world[1, :3] for camera in cameras], axis=0)
    assert tilt(tuple(mean / np.linalg.norm(mean)), (0.0, 0.0, 1.0)) > 10.0


@pytest.mark.parametrize("up", UPS)
def test_cameras_held_on_their_side_do_not_tilt_up(up: tuple[float, float, float]) -> None:
    """A third of the images in portrait, without anybody having turned them."""
    assert tilt(up_of_cameras(around(turn_to(up), side=3)), up) < 4.0


@pytest.mark.parametrize("up", UPS)
def test_up_of_aerial_images_is_whence_they_look(up: tuple[float, float, float]) -> None:
    """An aircraft that flies to and fro: ups cancel, views agree."""
    turn = turn_to(up)
    flown = [
        ls.Camera.look_at(turn @ (x, y, 50.0), turn @ (x, y, 0.0), turn @ (0.0, 1.0 - 2.0 * (y % 2), 0.0))
        for y in range(4)
        for x in range(5)
    ]
    assert tilt(up_of_cameras(flown), up) < 1e-6


def test_cameras_that_do_not_agree_say_nothing() -> None:
    """Those of a probe that looks to all sides, held every way."""
    everywhere = [ls.Camera.look_at((0, 0, 0), one, np.roll(one, 1)) for one in (*np.eye(3), *-np.eye(3))]
    assert up_of_cameras(everywhere) is None


@pytest.mark.parametrize("up", UPS)
def test_the_first_view_is_one_of_the_images_focused_on_what_all_look_at(up: tuple[float, float, float]) -> None:
    """Its eye, view and field of view are those of a camera; the distance is to where the axes meet."""
    turn = turn_to(up)
    cameras = around(turn, 90.0)
    view = first_view_of(cameras, SOME)
    (own,) = [one for one in cameras if np.allclose(one.camera_from_world, view.camera_from_world, atol=1e-9)]
    assert (view.fov_y, view.width, view.height) == (pytest.approx(own.fov_y), 30, 40)
    target = view.eye + view.focus_distance * view.camera_from_world[2, :3]
    np.testing.assert_allclose(target, turn @ np.full(3, 0.7), atol=1e-6)
    angle = math.degrees(math.atan2(*(turn.T @ view.eye - 0.7)[[1, 0]]))
    assert 30.0 < angle < 60.0  # the middle of the arc


def test_the_first_view_of_images_side_by_side_is_focused_on_what_is_seen() -> None:
    """Where no axes meet, the depth in the middle of the image counts."""
    cameras = [ls.Camera.look_at((x, 0.0, -5.0), (x, 0.0, 0.0), (0.0, -1.0, 0.0)) for x in (-1.0, 0.0, 1.0)]
    wall = np.column_stack([*np.meshgrid(np.linspace(-3, 3, 20), np.linspace(-3, 3, 20))]).reshape(-1, 2)
    view = first_view_of(cameras, np.column_stack([wall, np.full(len(wall), 2.0)]))
    np.testing.assert_allclose(view.eye, (0.0, 0.0, -5.0))
    assert view.focus_distance == pytest.approx(7.0)


@pytest.mark.parametrize("count", [1, 2])
def test_few_cameras_are_enough(count: int) -> None:
    """One image has a view, and an up."""
    cameras = around(np.eye(3), count=count)
    assert up_of_cameras(cameras) is not None
    assert first_view_of(cameras, SOME).focus_distance > 0.0
