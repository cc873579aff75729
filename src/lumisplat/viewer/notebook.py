"""Shows a viewer in a notebook cell: live frames with mouse control where possible, else a still image or text."""

from __future__ import annotations

import html
import logging
import math
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.page import Page, ScreenImage
from lumisplat.viewer.frames.pose import ASPECT, FirstView, Pose
from lumisplat.viewer.picking import select
from lumisplat.viewer.scene_extent import Vector
from lumisplat.viewer.session import Session
from lumisplat.viewer.thresholds import ANSWER_S

ELEVATION_MAX = math.radians(89.0)
"""Largest angle of the view direction above or below the horizon, radians; at 90 degrees the roll would be undefined.
"""

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Orbit:
    """Camera that looks at a target from a distance and rotates about it; lengths in scene units."""

    target: Vector
    """World position at the centre of the image."""
    backward: Vector
    """Unit vector from the target to the eye."""
    distance: float
    """Distance between target and eye, > 0."""
    up: Vector
    """Up direction of the scene, a unit vector."""
    fov_y: float
    """Vertical field of view, radians."""

    @classmethod
    def of(cls, eye: npt.ArrayLike, target: npt.ArrayLike, up: npt.ArrayLike, fov_y: float) -> Orbit:
        """Returns a camera that looks from an eye at a target; an elevation beyond +-`ELEVATION_MAX` is clamped."""
        offset = np.asarray(eye, np.float64) - np.asarray(target, np.float64)
        distance = float(np.linalg.norm(offset))
        orbit = cls(_vector(target), _vector(offset / distance), distance, _vector(_unit(up)), fov_y)
        return orbit.rotated(0.0, 0.0)

    @property
    def eye(self) -> Vector:
        """World position of the camera."""
        return _vector(np.array(self.target) + self.distance * np.array(self.backward))

    @property
    def elevation(self) -> float:
        """Angle of the camera above the horizontal plane through its target, radians; negative below."""
        return math.asin(min(max(float(np.dot(self.backward, self.up)), -1.0), 1.0))

    def rotated(self, around: float, above: float) -> Orbit:
        """Returns the camera moved on a sphere about its target.

        Args:
            around: Angle by which the eye moves about the vertical, to the right seen from the eye, radians.
            above: Angle by which the eye rises, radians; the elevation is clamped to +-`ELEVATION_MAX`.
        """
        up = np.array(self.up)
        level = self._level_backward()
        level = math.cos(around) * level + math.sin(around) * np.cross(up, level)
        elevation = min(max(self.elevation + above, -ELEVATION_MAX), ELEVATION_MAX)
        return replace(self, backward=_vector(math.cos(elevation) * level + math.sin(elevation) * up))

    def panned(self, across: float, down: float) -> Orbit:
        """Returns the camera moved with its target, parallel to the image, so that the scene follows the pointer.

        Args:
            across: Shift of the image content to the right, as a fraction of the image height.
            down: Shift of the image content downward, as a fraction of the image height.
        """
        height = 2.0 * self.distance * math.tan(0.5 * self.fov_y)
        right, downwards, _ = self.pose(1.0).camera(2).camera_from_world[:3, :3]
        return replace(self, target=_vector(np.array(self.target) - height * (across * right + down * downwards)))

    def zoomed(self, factor: float, nearest: float, farthest: float) -> Orbit:
        """Returns the camera with its distance to the target multiplied by a factor and clamped.

        Args:
            factor: Factor of the distance; less than 1 zooms in.
            nearest: Smallest distance, scene units.
            farthest: Largest distance, scene units.
        """
        return replace(self, distance=min(max(factor * self.distance, nearest), farthest))

    def pose(self, aspect: float) -> Pose:
        """Returns the camera as the pose of a page whose frames have an aspect ratio, width over height."""
        camera = ls.Camera.look_at(self.eye, self.target, self.up, width=2, height=2, fov_y=self.fov_y)
        return replace(Pose.through(camera, self.distance), aspect=aspect)

    def _level_backward(self) -> _Array:
        """Returns the horizontal unit vector from the target toward the eye; arbitrary if the eye is straight above."""
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


_ROTATION_PER_HEIGHT = 2.0 * math.pi
"""Angle by which the camera orbits when the pointer is dragged across the frame's height, radians."""
_ZOOM = 0.0015
"""Zoom speed of the mouse wheel: the camera distance is multiplied by ``exp(_ZOOM * dy)``; one notch is a dy of 100."""
_CLICK_PIXELS = 4.0
"""Longest pointer path between press and release that still counts as a click, pixels."""
_LEFT = 1


class PointerControl:
    """Moves an orbit camera by the mouse events of one notebook cell: drags orbit or pan, the wheel zooms.

    Args:
        orbit: Camera at the start.
        size: Scene size, scene units; the camera distance stays within 1e-4 to 1e3 times this size.
        width: Frame width, page pixels.
        height: Frame height, page pixels.
    """

    def __init__(self, orbit: Orbit, size: float, width: float, height: float) -> None:
        self.orbit, self._size = orbit, size
        self._width, self._height = width, height
        self._at: tuple[float, float] | None = None
        """Pointer position of the last event, page pixels, while a mouse button is down; None otherwise."""
        self._path_length = 0.0

    @property
    def aspect(self) -> float:
        """Aspect ratio of the frame, width over height."""
        return self._width / self._height

    def handle(self, event: Mapping[str, Any]) -> tuple[float, float] | None:
        """Moves the camera by a mouse event, and recognises clicks.

        Args:
            event: Event of jupyter_rfb, a dictionary with ``type``, ``x`` and ``y``.

        Returns:
            The clicked point as fractions of width and height, from the upper left; None if the event is not a click.
        """
        match event["type"]:
            case "resize":
                self._width, self._height = max(event["width"], 1.0), max(event["height"], 1.0)
            case "pointer_down":
                self._at, self._path_length = (event["x"], event["y"]), 0.0
            case "pointer_move" if self._at is not None:
                self._drag(event)
            case "pointer_up" if self._at is not None:
                self._at = None
                if self._path_length <= _CLICK_PIXELS and event["button"] == _LEFT:
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
        self._at, self._path_length = (event["x"], event["y"]), self._path_length + math.hypot(across, down)
        if event["button"] != _LEFT or "Shift" in event["modifiers"]:
            self.orbit = self.orbit.panned(across / self._height, down / self._height)
        else:
            self.orbit = self.orbit.rotated(
                -_ROTATION_PER_HEIGHT * across / self._height, _ROTATION_PER_HEIGHT * down / self._height
            )


_log = logging.getLogger("lumisplat")

Bundle = tuple[dict[str, Any], dict[str, Any]]
"""Result of IPython's ``_repr_mimebundle_``: an object's representations and their metadata, each by MIME type."""

_WIDGET = "application/vnd.jupyter.widget-view+json"
_TEXT = "text/plain"
_FRAME_S = 60.0
"""Longest time that displaying a viewer waits for the first frame, seconds; kernels may have to compile."""
_SAMPLES_S = 2.0
"""Time for which a still image for a notebook accumulates samples after its first full frame, seconds."""


class Notebook:
    """Represents a viewer in notebook cells, as live frames, a still image or text.

    Args:
        session: Session to show.
        loop: Render loop of the session.
        url: Address of the page.
    """

    def __init__(self, session: Session, loop: RenderLoop, url: str) -> None:
        self._session, self._loop, self._url = session, loop, url
        self._cell: Cell | None = None
        self._missing = ""
        """Error message that names the package missing for live frames, added to the text output; empty if none is
        missing."""

    def bundle(
        self, text: str, view: FirstView, include: Collection[str] | None, exclude: Collection[str] | None
    ) -> Bundle:
        """Returns what a notebook cell displays for the viewer, by MIME type: live frames, a still image, text.

        Args:
            text: Plain-text representation.
            view: First view of the scene.
            include: MIME types to include; None includes all.
            exclude: MIME types to leave out; None excludes none.
        """

        def is_wanted(kind: str) -> bool:
            return (not include or kind in include) and kind not in (exclude or ())

        scale = self._session.extent.page_from_scene
        eye, target = view.at(ASPECT)
        orbit = Orbit.of(eye / scale, target / scale, view.up, view.fov_y)
        data: dict[str, Any] = {}
        about: dict[str, Any] = {}
        cell = self._live(orbit) if is_wanted(_WIDGET) else None
        frame: ls.Frame | None = None
        if any(map(is_wanted, ("image/png", "image/jpeg"))) and can_show_images():
            frame = self._picture(orbit) if cell is None else self._first_frame(cell.page, samples_s=0.0)
        if frame is not None:
            data, about = frame._repr_mimebundle_(include, exclude)  # pyright: ignore[reportPrivateUsage]
        if cell is not None:
            data[_WIDGET] = cell.widget._repr_mimebundle_()[_WIDGET]
        if is_wanted(_TEXT):
            data[_TEXT] = f"{text}\n{self._missing}" if self._missing else text
        return data, about

    def close(self) -> None:
        """Stops the live frames in notebook cells; their last frame stays."""
        if self._cell is not None:
            self._cell.close()

    def _live(self, orbit: Orbit) -> Cell | None:
        """Returns the widget with live frames; None in a kernel without a user or without jupyter_rfb (logged once)."""
        if not has_interactive_user():
            return None
        if self._cell is None or not self._cell.page.is_open:
            try:
                self._cell = Cell(self._session, self._loop, orbit, self._url)
            except ls.errors.MissingExtraError as error:
                if not self._missing:
                    _log.warning("%s", error)
                self._missing = str(error)
                return None
        return self._cell

    def _picture(self, orbit: Orbit) -> ls.Frame | None:
        """Renders a still frame from a camera; returns None if rendering fails or no frame comes in time."""
        page = Page(_NullScreen(), self._session.changed)
        page.set_pose(orbit.pose(ASPECT))
        self._loop.add(page)
        try:
            return self._first_frame(page, _SAMPLES_S)
        finally:
            self._loop.remove(page)

    def _first_frame(self, page: Page, samples_s: float) -> ls.Frame | None:
        """Returns the latest frame of the notebook's page; if there is none yet, waits for one.

        Waits at most `_FRAME_S` seconds for the first full frame, then at most ``samples_s`` seconds for more samples.
        """
        if page.frame is None:
            self._wait(lambda: page.frames_at_rest > 0 or page.is_finished, _FRAME_S)
            self._wait(lambda: page.is_finished, samples_s)
        return page.frame

    def _wait(self, holds: Callable[[], bool], seconds: float) -> None:
        changed: threading.Condition = self._session.changed
        with changed:
            changed.wait_for(holds, seconds)


class _NullScreen:
    """Screen that discards images, for a page whose frames are read from `Page.frame` instead of being displayed."""

    def show(self, shown: ScreenImage) -> None:
        """Discards the image and returns at once."""

    def close(self) -> None:
        """Does nothing, because `show` never waits."""


WIDTH, HEIGHT = 640, 360
"""Width and height of the frame in the notebook at the start, page pixels."""
_LINK = '<a href="{}" target="_blank" style="text-decoration: underline">open the page</a>'


class Cell:
    """A notebook widget with a live frame and a line of text: the page address and the result of a click.

    All notebook cells that display the viewer are views of one widget, with one camera.

    Args:
        session: Session to show.
        loop: Render loop of the session.
        orbit: Camera at the start.
        url: Address of the page.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """

    def __init__(self, session: Session, loop: RenderLoop, orbit: Orbit, url: str) -> None:
        ipywidgets, _ = import_widgets()
        self._session, self._loop, self._url = session, loop, url
        self._pointer = PointerControl(orbit, session.extent.size, WIDTH, HEIGHT)
        self.buffer = frame_buffer(WIDTH, HEIGHT, self._on_event)
        self._line = ipywidgets.HTML()
        self.widget = ipywidgets.VBox([self.buffer, self._line])
        """ipywidgets box with the live frame and the text line, which the notebook displays."""
        self.page = Page(CellScreen(self.buffer), session.changed)
        self.notify("")
        session.error_listeners.append(self.notify)
        self._look()
        loop.add(self.page)

    def notify(self, note: str) -> None:
        """Shows a note, such as the name of a clicked object, in the text line, beside the address of an open page."""
        link = _LINK.format(html.escape(self._url)) if self.page.is_open else ""
        self._line.value = " · ".join(part for part in (link, html.escape(note)) if part)

    def close(self) -> None:
        """Stops the live frames; the last frame stays in the notebook."""
        if not self.page.is_open:
            return
        self._session.error_listeners.remove(self.notify)
        self._loop.remove(self.page)
        self.notify("closed")

    def _on_event(self, event: dict[str, Any]) -> None:
        match event["type"]:
            case "close":
                self.close()
            case "hide":
                self.page.set_pose(None)
            case "show":  # a browser that shows the cell again has no image yet
                self.page.set_pose(None)
                self._look()
            case _:
                self._on_pointer(event)

    def _on_pointer(self, event: dict[str, Any]) -> None:
        click = self._pointer.handle(event)
        self._look()
        if event["type"] == "pointer_up":
            self.page.stop()
        if click is None or self.page.frame is None:
            return
        seen = select(self._session, self.page.frame, *click, is_level=not self.page.frames_at_rest)
        self.notify("" if seen is None else f"{seen[0]}: {seen[1]}")

    def _look(self) -> None:
        self.page.set_pose(self._pointer.orbit.pose(self._pointer.aspect))


def import_widgets() -> tuple[Any, Any]:
    """Returns the modules ipywidgets and jupyter_rfb.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    try:
        return import_module("ipywidgets"), import_module("jupyter_rfb")  # neither has types
    except ImportError:
        raise ls.errors.MissingExtraError("live frames in a notebook's cell", "notebook") from None


def frame_buffer(width: int, height: int, on_event: Callable[[dict[str, Any]], None]) -> Any:
    """Creates the widget that displays the images of a `CellScreen`.

    Args:
        width: Width in the notebook, page pixels; users can resize the widget.
        height: Height in the notebook, page pixels.
        on_event: Called with each event, in a thread of the kernel.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    from IPython.utils.capture import capture_output

    _, jupyter_rfb = import_widgets()
    with capture_output(stdout=False, stderr=False):  # the widget's error output would be an empty line above the frame
        buffer = jupyter_rfb.RemoteFrameBuffer(css_width=f"{width}px", css_height=f"{height}px")
    buffer.handle_event = on_event
    return buffer


class CellScreen:
    """Sends images to a notebook widget, and waits until the widget acknowledges that it has drawn each.

    While the kernel runs a cell, acknowledgements do not arrive; each wait then ends after `ANSWER_S` seconds.

    Args:
        buffer: Widget of `frame_buffer`; only this screen may send frames to it.
    """

    def __init__(self, buffer: Any) -> None:
        self._buffer = buffer
        self._sent = 0
        self._is_there = threading.Event()
        buffer.observe(self._on_answer, names="_frame_feedback")

    def show(self, shown: ScreenImage) -> None:
        """Sends an image and waits until the widget has drawn it."""
        self._is_there.clear()
        self._sent += 1
        self._buffer.quality = shown.quality
        self._buffer.send_frame(shown.picture)
        self._is_there.wait(ANSWER_S)

    def close(self) -> None:
        """Makes a `show` that waits in another thread return."""
        self._is_there.set()

    def _on_answer(self, change: Any) -> None:
        if change["new"].get("index", 0) >= self._sent:
            self._is_there.set()


def has_interactive_user() -> bool:
    """True in a notebook kernel whose front end accepts input; False without a kernel or in tools like nbconvert."""
    kernel = getattr(_shell(), "kernel", None)
    if kernel is None:
        return False
    return bool(kernel.get_parent("shell").get("content", {}).get("allow_stdin", False))


def can_show_images() -> bool:
    """True if IPython's front end displays PNG images, as notebooks do and terminals do not; True without IPython."""
    shell = _shell()
    return shell is None or "image/png" in shell.display_formatter.active_types


def _shell() -> Any:
    """Returns the IPython shell; None outside IPython."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return None
    return get_ipython()
