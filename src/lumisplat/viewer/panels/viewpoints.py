"""Where a page may look from: at all of the scene, at what is selected, or through a camera of the scene file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pose import look_through
from lumisplat.viewer.server.turns import pressed
from lumisplat.viewer.state.boxes import pose_of, world_corners
from lumisplat.viewer.state.extent import Extent
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_ALL = "all of it"
_SELECTED = "what is selected"


class Viewpoints:
    """A list of viewpoints and a button that goes there, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the scene.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        self._place = gui.add_dropdown("look at", [_ALL, _SELECTED], hint="Or through a camera of the scene file.")
        gui.add_button("go there").on_click(pressed(self._go))
        self._cameras: dict[str, ls.Camera] = {}
        self._shown: object = None
        session.on_change(self._show)

    def look_at_all(self, event: Any) -> None:
        """Moves a page so that it sees all, from the side from which it looks."""
        if event.client is not None:
            extent = Extent.of(self._session.scene)  # also of what was added or moved
            self._look_at(event.client, np.array(extent.center), 0.5 * extent.size)

    def look_at_selected(self, event: Any) -> None:
        """Moves a page so that it sees what is selected."""
        with self._session.changed:
            ball = selected_ball(self._session)
        if ball is None:
            self._session.report("nothing is selected that is anywhere: click a thing, or choose it in the list")
        elif event.client is not None:
            self._look_at(event.client, *ball)

    def _show(self) -> None:
        """Lists the cameras of the scene file."""
        document = self._session.state.document
        if self._shown is not document.top.get("cameras"):
            self._shown = document.top.get("cameras")
            self._cameras = {camera.name: camera for camera in document.cameras}
            self._place.options = [_ALL, _SELECTED, *self._cameras]

    def _go(self, event: Any) -> None:
        camera = self._cameras.get(str(self._place.value))
        if self._place.value == _ALL:
            self.look_at_all(event)
        elif self._place.value == _SELECTED:
            self.look_at_selected(event)
        elif camera is not None and event.client is not None:
            session = self._session
            look_through(event.client, camera, session.extent.page_from_scene, session.scene.up_direction)

    def _look_at(self, client: viser.ClientHandle, center: np.ndarray, radius: float) -> None:
        """Moves a page along the line of its sight so that a ball fills it."""
        scale, camera = self._session.extent.page_from_scene, client.camera
        backward = np.asarray(camera.position) - np.asarray(camera.look_at)
        backward = backward / max(float(np.linalg.norm(backward)), 1e-9)
        narrow = math.atan(math.tan(0.5 * camera.fov) * min(camera.aspect, 1.0))
        with client.atomic():
            camera.up_direction = self._session.scene.up_direction
            camera.position = scale * (center + backward * radius / math.sin(narrow))
            camera.look_at = scale * center  # last, for the position takes it along


def selected_ball(session: Session) -> tuple[np.ndarray, float] | None:
    """The middle and the radius of what is selected; None: nothing that is anywhere."""
    entry, time = session.selected_entry, session.options.time
    if entry is None:
        return None
    if entry.kind == "lights" and (position := getattr(entry.lights[0], "position", None)) is not None:
        return np.array(position, np.float64), 0.2 * session.extent.size
    box, pose = session.boxes.of(entry, time), pose_of(entry, time)
    if box is None or pose is None:
        return None
    corners = world_corners(box, pose)
    middle = corners.mean(axis=0)
    return middle, float(np.linalg.norm(corners[0] - middle))
