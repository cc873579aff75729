"""A camera that turns about a point, stays upright, and follows the mouse in a notebook's cell."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.state.scene_extent import Vector

ELEVATION_MAX = math.radians(89.0)
"""Angle between the sight and the ground beyond which a camera does not turn: at the poles up would be anywhere."""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Orbit:
    """Where a camera is around what it looks at, in units of the scene."""

    target: Vector
    """What is in the middle of the picture."""
    backward: Vector
    """From the target to the eye, of length 1."""
    distance: float
    """From the target to the eye, above 0."""
    up: Vector
    """Of the scene, of length 1."""
    fov_y: float
    """Vertical field of view, radians."""

    @classmethod
    def of(cls, eye: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike, fov_y: float) -> Orbit:
        """The camera that looks from one point at another; no steeper than it can turn."""
        offset = np.asarray(eye, np.float64) - np.asarray(target, np.float64)
        distance = float(np.linalg.norm(offset))
        orbit = cls(_vector(target), _vector(offset / distance), distance, _vector(_unit(up)), fov_y)
        return orbit.turned(0.0, 0.0)

    @property
    def eye(self) -> Vector:
        """Where it is."""
        return _vector(np.array(self.target) + self.distance * np.array(self.backward))

    @property
    def elevation(self) -> float:
        """Angle of the eye above the ground through the target, radians."""
        return math.asin(min(max(float(np.dot(self.backward, self.up)), -1.0), 1.0))

    def turned(self, around: float, above: float) -> Orbit:
        """Turned about its target.

        Args:
            around: To the right about the vertical, radians.
            above: Upwards, radians; it ends short of the poles.
        """
        up = np.array(self.up)
        level = self._level_backward()
        level = math.cos(around) * level + math.sin(around) * np.cross(up, level)
        elevation = min(max(self.elevation + above, -ELEVATION_MAX), ELEVATION_MAX)
        return replace(self, backward=_vector(math.cos(elevation) * level + math.sin(elevation) * up))

    def moved(self, across: float, down: float) -> Orbit:
        """Moved with what it looks at, so that the target goes with the pointer.

        Args:
            across: What the target moves to the right in the picture, in heights of the picture.
            down: Likewise downwards.
        """
        height = 2.0 * self.distance * math.tan(0.5 * self.fov_y)
        right, downwards, _ = self.pose(1.0).camera(2).camera_from_world[:3, :3]
        return replace(self, target=_vector(np.array(self.target) - height * (across * right + down * downwards)))

    def zoomed(self, factor: float, nearest: float, farthest: float) -> Orbit:
        """Nearer to its target, or farther away.

        Args:
            factor: Of the distance.
            nearest: Least distance.
            farthest: Largest distance.
        """
        return replace(self, distance=min(max(factor * self.distance, nearest), farthest))

    def pose(self, aspect: float) -> Pose:
        """As pages have it, at a width to height."""
        camera = ls.Camera.look_at(self.eye, self.target, self.up, width=2, height=2, fov_y=self.fov_y)
        return replace(Pose.through(camera, self.distance), aspect=aspect)

    def _level_backward(self) -> _Array:
        """The direction to the eye along the ground, of length 1; any, where the eye is above the target."""
        up, backward = np.array(self.up), np.array(self.backward)
        for direction in (backward, np.eye(3)[np.abs(up).argmin()]):
            level = direction - float(direction @ up) * up
            if np.linalg.norm(level) > 1e-6:
                break
        return _unit(level)


def _unit(vector: npt.ArrayLike) -> _Array:
    array = np.asarray(vector, np.float64)
    return array / np.linalg.norm(array)


def _vector(array: npt.ArrayLike) -> Vector:
    x, y, z = (float(value) for value in np.asarray(array))
    return x, y, z


_TURN = 2.0 * math.pi
"""Angle by which a camera turns while the pointer crosses the height of the frame, radians."""
_ZOOM = 0.0015
"""Logarithm of the factor of the distance for a pixel of the wheel; a notch is 100."""
_CLICK_PIXELS = 4.0
"""Way of a pointer between press and release, beyond which it was no click."""
_LEFT = 1


class Hand:
    """Follows the events of one cell, as jupyter_rfb sends them.

    Args:
        orbit: The camera at first.
        size: Size of the scene, which bounds how near and far the camera goes.
        width: Width of the frame, pixels of the page.
        height: Its height.
    """

    def __init__(self, orbit: Orbit, size: float, width: float, height: float) -> None:
        self.orbit, self._size = orbit, size
        self._width, self._height = width, height
        self._at: tuple[float, float] | None = None
        """Where the pointer was last, while it is pressed."""
        self._way = 0.0

    @property
    def aspect(self) -> float:
        """Width to height of the frame."""
        return self._width / self._height

    def feel(self, event: Mapping[str, Any]) -> tuple[float, float] | None:
        """Takes an event.

        Returns:
            The shares of the width and the height at which there was a click; None: this is none.
        """
        match event["type"]:
            case "resize":
                self._width, self._height = max(event["width"], 1.0), max(event["height"], 1.0)
            case "pointer_down":
                self._at, self._way = (event["x"], event["y"]), 0.0
            case "pointer_move" if self._at is not None:
                self._drag(event)
            case "pointer_up" if self._at is not None:
                self._at = None
                if self._way <= _CLICK_PIXELS and event["button"] == _LEFT:
                    return event["x"] / self._width, event["y"] / self._height
            case "wheel":
                factor = math.exp(_ZOOM * event["dy"])
                self.orbit = self.orbit.zoomed(factor, 1e-4 * self._size, 1e3 * self._size)
            case _:
                pass
        return None

    def _drag(self, event: Mapping[str, Any]) -> None:
        assert self._at is not None
        across, down = event["x"] - self._at[0], event["y"] - self._at[1]
        self._at, self._way = (event["x"], event["y"]), self._way + math.hypot(across, down)
        if event["button"] != _LEFT or "Shift" in event["modifiers"]:
            self.orbit = self.orbit.moved(across / self._height, down / self._height)
        else:
            self.orbit = self.orbit.turned(-_TURN * across / self._height, _TURN * down / self._height)
