"""What a hand on the mouse means: events of a cell become a camera that moves, and clicks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lumisplat.viewer.notebook.orbit import Orbit

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
