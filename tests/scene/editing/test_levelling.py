"""Up found by the ground, by points, or by a capture's own axes, in worlds turned any way; and captures turned."""

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


def capture(points: np.ndarray, scale: float = 0.02, **said: Any) -> ls.Gaussians:
    """Round Gaussians at points."""
    count = len(points)
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    return ls.Gaussians(points, turns, np.full((count, 3), scale), np.full(count, 0.8), np.zeros((count, 1, 3)), **said)


def box(low: tuple[float, ...], high: tuple[float, ...], count: int, seed: int = 0) -> np.ndarray:
    """Points on the faces of a box."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(low, high, (count, 3))
    axis, side = rng.integers(0, 3, count), rng.integers(0, 2, count)
    points[np.arange(count), axis] = np.where(side, np.array(high)[axis], np.array(low)[axis])
    return points


def floor(count: int = 3000, half: float = 3.0) -> np.ndarray:
    """A rough ground at y = 0, with strays below it."""
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
    """Degrees by which what was found is off."""
    return math.degrees(math.acos(min(1.0, float(np.array(present(found.up)) @ up))))


def turned(points: np.ndarray, degrees: tuple[float, float, float]) -> tuple[ls.Gaussians, np.ndarray]:
    """A capture that says its up, turned, and that up; the capture then no longer says it."""
    moved = ls.transform(capture(points, up=DOWN), rotation_degrees=degrees)
    return replace(moved, up=None), np.array(present(moved.up))


@pytest.mark.parametrize("degrees", TILTS)
@pytest.mark.parametrize("points", [GARDEN, ROOM], ids=["garden", "room"])
def test_the_ground_tells_which_way_is_up(points: np.ndarray, degrees: tuple[float, float, float]) -> None:
    """A thing on a ground, and a room from inside, to a quarter of a degree; no wall, table or ceiling is a ground."""
    one, up = turned(points, degrees)
    found = ls.editing.find_up(ls.Scene([one]))
    assert found.source == "ground"
    assert off(found, up) < 0.25
    assert present(found.height) == pytest.approx(0.0, abs=0.02)
    assert 0.1 < present(found.share) < 0.7


def test_a_level_capture_stands_along_an_axis() -> None:
    """It is turned, says so, and is level to whoever looks at it next."""
    one, _ = turned(GARDEN, (20.0, 10.0, -15.0))
    level = ls.editing.level(one)
    assert level.up == (0.0, -1.0, 0.0)
    lowest = level.means[:3000, 1]
    assert np.std(lowest) < 0.02
    assert off(ls.editing.find_up(ls.Scene([replace(level, up=None)])), DOWN) < 0.25


@pytest.mark.parametrize("stated", ["z-up", "y-up", (0.1, 0.2, 0.9)])
def test_a_capture_is_levelled_to_the_axis_that_it_states(stated: Any) -> None:
    """Files of nerfstudio stay z up: the axis is that nearest to what the file says, however the ground is tilted."""
    axis = np.array(ls.Scene(up="y-up" if stated == "y-up" else "z-up").up_direction)
    turn = np.cross(DOWN, axis)
    aligned = ls.editing.level(capture(GARDEN, up=axis), DOWN) if turn.any() or axis[1] > 0 else capture(GARDEN)
    crooked = replace(ls.transform(aligned, rotation_degrees=(8.0, -6.0, 5.0)), up=stated)
    level = ls.editing.level(crooked)
    assert level.up == tuple(axis)
    assert np.std((level.means @ axis)[:3000]) < 0.02


def test_a_thing_without_a_ground_stands_along_its_own_axis() -> None:
    """Its back, flat as it is, is no ground; and what stands straight already is left as it is."""
    one, up = turned(GUITAR, (20.0, 15.0, -25.0))
    found = ls.editing.find_up(ls.Scene([one]))
    assert found.source == "axes"
    assert off(found, up) < 3.0
    assert off(ls.editing.find_up(ls.Scene([capture(GUITAR)])), DOWN) < 1e-5


def test_a_stated_up_stays_where_there_is_no_ground() -> None:
    """The cameras knew better than the shape of what they saw."""
    up = (0.2, 0.1, 0.9)
    found = ls.editing.find_up(ls.Scene([capture(GUITAR, up=up)]))
    assert (found.source, found.height) == ("stated", None)
    assert off(found, np.array(up) / np.linalg.norm(up)) < 1e-5


def test_a_wall_is_no_ground_of_a_capture_that_states_its_up() -> None:
    """However large it is: 50 degrees from what the cameras say is the end."""
    wall = floor()[:, [1, 0, 2]]
    found = ls.editing.find_up(ls.Scene([capture(wall, up=DOWN)]))
    assert found.source == "stated"


def test_a_ball_has_no_up() -> None:
    """That is said, with what to do."""
    rng = np.random.default_rng(2)
    ball = rng.normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    with pytest.raises(ls.SceneError, match="has no distinct axis: give three points"):
        ls.editing.find_up(ls.Scene([capture(ball)]))


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)])
@pytest.mark.parametrize("degrees", [*TILTS, (170.0, 10.0, 20.0)])
def test_three_points_tell_which_way_is_up(degrees: tuple[float, float, float], order: tuple[int, ...]) -> None:
    """In any order, and however far the capture is turned: up is on the side where it is."""
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
def test_points_that_are_no_ground_are_refused(points: Any) -> None:
    """Too few, on a line, or none at all."""
    with pytest.raises(ls.SceneError, match=r"at least three points|are collinear"):
        ls.editing.find_up(ls.Scene([capture(GARDEN)]), points)


def test_scenes_without_captures_are_refused() -> None:
    """There is nothing to look at."""
    with pytest.raises(ls.SceneError, match="the scene has none"):
        ls.editing.find_up(ls.Scene())


def test_up_of_placed_captures_is_in_the_world() -> None:
    """Instances are looked at where they stand."""
    place = ls.SplatInstance(capture(GARDEN), rotation_degrees=(90.0, 0.0, 0.0), scale_by=3.0)
    found = ls.editing.find_up(ls.Scene([place]))
    assert off(found, place.transform[:3, :3] @ DOWN / 3.0) < 0.25


def test_the_same_capture_gives_the_same_bits() -> None:
    """Chance is drawn from a fixed seed."""
    one, _ = turned(ROOM, (25.0, 60.0, 30.0))
    assert ls.editing.find_up(ls.Scene([one])) == ls.editing.find_up(ls.Scene([one]))
