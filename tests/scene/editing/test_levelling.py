"""Up is found from the ground, points or a capture's principal axes, in any orientation, and captures are levelled."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.kinds import present

DOWN = np.array((0.0, -1.0, 0.0))
TILTS = [(0.0, 0.0, 0.0), (12.0, 5.0, -8.0), (25.0, 60.0, 30.0)]


def capture(points: np.ndarray, scale: float = 0.02, **stated: Any) -> ls.Gaussians:
    """Returns spherical Gaussians at points."""
    count = len(points)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return ls.Gaussians(
        points, turns, np.full((count, 3), scale), np.full(count, 0.8), np.zeros((count, 1, 3)), **stated
    )


def box(low: tuple[float, ...], high: tuple[float, ...], count: int, seed: int = 0) -> np.ndarray:
    """Returns points on the faces of a box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    points[np.arange(count), axis] = np.where(side, np.array(high)[axis], np.array(low)[axis])
    return points


def floor(count: int = 3000, half: float = 3.0) -> np.ndarray:
    """Returns a rough ground at y = 0, with strays below it."""
    rng = np.random.default_rng(1)
    points = np.column_stack(
        [rng.uniform(-half, half, count), 0.01 * rng.normal(size=count), rng.uniform(-half, half, count)]
    )
    return np.concatenate([points, rng.uniform((-half, 0.1, -half), (half, 1.5, half), (count // 50, 3))])


GARDEN = np.concatenate([floor(), box((-0.5, -1.5, -0.4), (0.5, 0.0, 0.4), 3000)])
ROOM = np.concatenate([box((-3.0, -2.4, -2.0), (3.0, 0.0, 2.0), 9000), box((-1.0, -0.8, -0.5), (0.0, 0.0, 0.5), 1500)])
GUITAR = np.concatenate(
    [box((-0.25, -0.5, -0.05), (0.25, 0.0, 0.05), 3000), box((-0.03, -1.2, -0.02), (0.03, -0.5, 0.02), 600)]
)


def off(found: ls.editing.UpEstimate | ls.Gaussians, up: np.ndarray) -> float:
    """Returns the angle in degrees between found and true up."""
    return math.degrees(math.acos(min(1.0, float(np.array(present(found.up)) @ up))))


def turned(points: np.ndarray, degrees: tuple[float, float, float]) -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a rotated capture without a stated up, and its true up."""
    moved = ls.transform(capture(points, up=DOWN), rotation_degrees=degrees)
    return replace(moved, up=None), np.array(present(moved.up))


@pytest.mark.parametrize("degrees", TILTS)
@pytest.mark.parametrize("points", [GARDEN, ROOM], ids=["garden", "room"])
def test_find_up_returns_the_normal_of_the_ground_of_a_capture(
    points: np.ndarray, degrees: tuple[float, float, float]
) -> None:
    """Up is found within a quarter of a degree on an object's ground and in a room; walls and tables are no ground."""
    one, up = turned(points, degrees)
    found = ls.editing.find_up(ls.Scene([one]))
    assert found.source == "ground"
    assert off(found, up) < 0.25
    assert present(found.height) == pytest.approx(0.0, abs=0.02)
    assert 0.1 < present(found.share) < 0.7


def test_levelled_capture_has_an_up_direction_along_a_coordinate_axis() -> None:
    """A levelled capture states its up along an axis, and is found to be level."""
    one, _ = turned(GARDEN, (20.0, 10.0, -15.0))
    level = ls.editing.level(one)
    assert level.up == (0.0, -1.0, 0.0)
    lowest = level.means[:3000, 1]
    assert np.std(lowest) < 0.02
    assert off(ls.editing.find_up(ls.Scene([replace(level, up=None)])), DOWN) < 0.25


@pytest.mark.parametrize("stated", ["z-up", "y-up", (0.1, 0.2, 0.9)])
def test_level_rotates_the_ground_to_the_axis_nearest_to_the_captures_stated_up_direction(stated: Any) -> None:
    """Levelling takes the axis nearest to the stated up, so that nerfstudio's files stay z up."""
    axis = np.array(ls.Scene(up="y-up" if stated == "y-up" else "z-up").up_direction)
    turn = np.cross(DOWN, axis)
    aligned = ls.editing.level(capture(GARDEN, up=axis), DOWN) if turn.any() or axis[1] > 0 else capture(GARDEN)
    crooked = replace(ls.transform(aligned, rotation_degrees=(8.0, -6.0, 5.0)), up=stated)
    level = ls.editing.level(crooked)
    assert level.up == tuple(axis)
    assert np.std((level.means @ axis)[:3000]) < 0.02


def test_find_up_returns_a_principal_axis_for_a_captured_object_without_ground() -> None:
    """The flat back of a guitar does not count as a ground, and an upright guitar keeps its up."""
    one, up = turned(GUITAR, (20.0, 15.0, -25.0))
    found = ls.editing.find_up(ls.Scene([one]))
    assert found.source == "axes"
    assert off(found, up) < 3.0
    assert off(ls.editing.find_up(ls.Scene([capture(GUITAR)])), DOWN) < 1e-5


def test_find_up_returns_the_stated_up_direction_of_a_capture_without_ground() -> None:
    """Without a ground, the stated up counts more than the object's shape."""
    up = (0.2, 0.1, 0.9)
    found = ls.editing.find_up(ls.Scene([capture(GUITAR, up=up)]))
    assert (found.source, found.height) == ("stated", None)
    assert off(found, np.array(up) / np.linalg.norm(up)) < 1e-5


def test_find_up_does_not_mistake_a_wall_for_the_ground_of_a_capture_with_a_stated_up_direction() -> None:
    """A plane more than 50 degrees off the stated up is no ground, however large it is."""
    wall = floor()[:, [1, 0, 2]]
    found = ls.editing.find_up(ls.Scene([capture(wall, up=DOWN)]))
    assert found.source == "stated"


def test_find_up_refuses_to_guess_the_up_direction_of_a_ball_without_ground() -> None:
    """The error reports that a ball has no distinct axis, and suggests three points."""
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    with pytest.raises(ls.SceneError, match="has no distinct axis: give three points"):
        ls.editing.find_up(ls.Scene([capture(ball)]))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)])
@pytest.mark.parametrize("degrees", [*TILTS, (170.0, 10.0, 20.0)])
def test_find_up_from_three_ground_points_is_exact_for_any_order_of_the_points(
    degrees: tuple[float, float, float], order: tuple[int, ...]
) -> None:
    """The capture lies on the upper side of the plane through the points."""
    one, up = turned(GARDEN, degrees)
    corners = ls.transform(
        capture(np.array([(-3.0, 0, -3.0), (3.0, 0, -3.0), (0.0, 0, 3.0)])), rotation_degrees=degrees
    )
    found = ls.editing.find_up(ls.Scene([one]), corners.means[list(order)])
    assert found.source == "points"
    assert off(found, up) < 1e-3
    assert present(found.height) == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize(
    "points",
    [
        [(0, 0, 0), (1, 0, 0)],
        [(0, 0, 0), (1, 0, 0), (2, 0, 0)],
        [(0, 0), (1, 0), (0, 1)],
        3,
        [(0, 0, math.nan)] * 3,
        "abc",
    ],
)
def test_find_up_refuses_ground_points_that_are_too_few_collinear_or_invalid(points: Any) -> None:
    """Too few, collinear or invalid points are refused."""
    with pytest.raises(ls.SceneError, match=r"at least three points|are collinear"):
        ls.editing.find_up(ls.Scene([capture(GARDEN)]), points)


def test_find_up_refuses_a_scene_without_captures() -> None:
    """A scene without captures has no Gaussians to find up from."""
    with pytest.raises(ls.SceneError, match="the scene has none"):
        ls.editing.find_up(ls.Scene())


def test_find_up_returns_the_up_direction_of_a_transformed_capture_in_world_space() -> None:
    """Up is found in world space, after the instance's transform."""
    place = ls.SplatInstance(capture(GARDEN), rotation_degrees=(90.0, 0.0, 0.0), scale_by=3.0)
    found = ls.editing.find_up(ls.Scene([place]))
    assert off(found, place.transform[:3, :3] @ DOWN / 3.0) < 0.25


def test_find_up_gives_identical_results_in_repeated_calls() -> None:
    """Random samples come from a fixed seed."""
    one, _ = turned(ROOM, (25.0, 60.0, 30.0))
    assert ls.editing.find_up(ls.Scene([one])) == ls.editing.find_up(ls.Scene([one]))
