"""Up of the scene: fitted to the ground of the captures, or defined by three points of it that are clicked."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.gizmos_and_picking.picking import picked
from lumisplat.viewer.panels.controls import set_if_changed
from lumisplat.viewer.server.event_queue import pressed
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser


Vector = tuple[float, float, float]

_LEVEL_HINT = "Fits the ground of the captures, and makes its normal up. What stands upright turns with it."
_CLICK_HINT = "Click three points of the ground in the picture, far apart: their plane becomes horizontal."
_CLICK = "click 3 points of the ground"
_ON_LINE = 0.02
"""Sine of an angle of three points below which they lie on a line: a plane through them would be noise."""
_SAME = math.radians(0.05)
"""Angle between two ups below which nothing is changed."""


class LevelPanel:
    """Two buttons that set the up of the scene, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the scene.
        tell: Shows a note on all pages, by its title and its text.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, tell: Callable[[str, str], object]) -> None:
        self._session, self._tell = session, tell
        self._fits = gui.add_button("level", hint=_LEVEL_HINT)
        self._fits.on_click(pressed(lambda _: self.fit()))
        self._clicks = gui.add_button(_CLICK, hint=_CLICK_HINT, color="gray")
        self._clicks.on_click(pressed(lambda _: self.start()))
        session.on_change(self._show)

    def fit(self) -> None:
        """Makes the normal of the captures' ground up."""
        try:
            found = ls.editing.find_up(self._session.scene)
        except ls.LumisplatError as error:
            self._session.report(f"{error}: click three points of the ground")
            return
        if found.source == "ground":
            self._put(found.up, f"the ground is {found.share or 0.0:.0%} of what shows")
        elif found.source == "stated":
            self._tell("level", "no ground is found, and up stays as it is: click three points of the ground")
        else:
            self._put(found.up, "no ground is found: up is an axis of the captures (else click three points)")

    def start(self) -> None:
        """Takes the next three clicks for points of the ground; while it does, it stops."""
        points = () if self._session.ground_points is None else None
        self._session.set_ground_points(points)
        if points is not None:
            self._tell("level", _CLICK_HINT)

    def take(self, frame: ls.Frame, across: float, down: float) -> bool:
        """Takes a click as a point of the ground, and the third one makes up; False: it is no such click.

        Args:
            frame: What the page shows.
            across: Share of its width, from the left, 0..1.
            down: Share of its height, from the top, 0..1.
        """
        points = self._session.ground_points
        if points is None:
            return False
        pick = picked(frame, across, down)
        if pick is None:
            self._session.report("there is nothing at that point: click a point of the ground")
            return True
        x, y, z = (float(value) for value in pick.position)
        points = (*points, (x, y, z))
        if len(points) < 3:
            self._session.set_ground_points(points)
            return True
        self._session.set_ground_points(None)
        up = ground_normal(points, frame.camera.eye)
        if up is None:
            self._session.report("the three points lie on a line: click points that are farther apart")
        else:
            self._put(up, "up is at right angles to the three points")
        return True

    def _put(self, up: Vector, how: str) -> None:
        before = np.array(self._session.scene.up_direction)
        angle = math.atan2(float(np.linalg.norm(np.cross(before, up))), float(before @ np.array(up)))
        if angle < _SAME:
            self._tell("level", f"it is level: {how}")
        elif self._session.apply(lambda document: document.with_up(up)):
            self._tell("level", f"turned by {math.degrees(angle):.1f}°: {how}")

    def _show(self) -> None:
        scene, points = self._session.scene, self._session.ground_points
        set_if_changed(self._fits, "disabled", not scene.splats)
        set_if_changed(self._fits, "hint", _LEVEL_HINT if scene.splats else "It takes a capture. " + _LEVEL_HINT)
        label = _CLICK if points is None else f"{len(points)} of 3 clicked: cancel"
        set_if_changed(self._clicks, "label", label)


def ground_normal(points: Any, eye: npt.ArrayLike) -> Vector | None:
    """The unit normal of the plane through three points, on the side of the eye; None: they lie on a line.

    Args:
        points: World positions, shape (3, 3).
        eye: From where they are seen: whoever sees a ground is above it.
    """
    first, second, third = (np.asarray(point, np.float64) for point in points)
    one, other = second - first, third - first
    normal, longest = np.asarray(np.cross(one, other), np.float64), max(map(np.linalg.norm, (one, other, other - one)))
    if not np.linalg.norm(normal) > _ON_LINE * longest**2:
        return None
    normal *= math.copysign(1.0, float(normal @ (np.asarray(eye) - first))) / float(np.linalg.norm(normal))
    x, y, z = (round(float(value), 9) + 0.0 for value in normal)
    return x, y, z
