"""Shows a viewer as the result of a notebook's cell: live frames that follow the mouse, else an image, and a text."""

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
        return orbit.rotated(0.0, 0.0)

    @property
    def eye(self) -> Vector:
        """Where it is."""
        return _vector(np.array(self.target) + self.distance * np.array(self.backward))

    @property
    def elevation(self) -> float:
        """Angle of the eye above the ground through the target, radians."""
        return math.asin(min(max(float(np.dot(self.backward, self.up)), -1.0), 1.0))

    def rotated(self, around: float, above: float) -> Orbit:
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

    def panned(self, across: float, down: float) -> Orbit:
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


class PointerControl:
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
        self._path_length = 0.0

    @property
    def aspect(self) -> float:
        """Width to height of the frame."""
        return self._width / self._height

    def handle(self, event: Mapping[str, Any]) -> tuple[float, float] | None:
        """Takes an event.

        Returns:
            The shares of the width and the height at which there was a click; None: this is none.
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
            self.orbit = self.orbit.rotated(-_TURN * across / self._height, _TURN * down / self._height)


_log = logging.getLogger("lumisplat")

Bundle = tuple[dict[str, Any], dict[str, Any]]
"""Representations by MIME type, and what is known about them."""

_WIDGET = "application/vnd.jupyter.widget-view+json"
_TEXT = "text/plain"
_FRAME_S = 60.0
"""How long a cell waits for its first frame, seconds: kernels may have to be compiled."""
_SAMPLES_S = 2.0
"""How long a picture gathers samples, seconds."""


class Notebook:
    """Shows a session in cells.

    Args:
        session: What is shown.
        loop: Renders it.
        url: The address of the page.
    """

    def __init__(self, session: Session, loop: RenderLoop, url: str) -> None:
        self._session, self._loop, self._url = session, loop, url
        self._cell: Cell | None = None
        self._missing = ""
        """What to install for live frames, in a line; empty: nothing is missing."""

    def bundle(
        self, text: str, view: FirstView, include: Collection[str] | None, exclude: Collection[str] | None
    ) -> Bundle:
        """What a cell shows whose result is the viewer.

        Args:
            text: In words.
            view: Where to look from.
            include: The MIME types that are wanted; None: all.
            exclude: MIME types that are not wanted; None: none.
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
        """Ends the frames in cells."""
        if self._cell is not None:
            self._cell.close()

    def _live(self, orbit: Orbit) -> Cell | None:
        """The cell with live frames; None: nobody would see them, or a package is missing, which is told once."""
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
        """A frame of the scene; None: it cannot be rendered, or not soon."""
        page = Page(_NullScreen(), self._session.changed)
        page.set_pose(orbit.pose(ASPECT))
        self._loop.add(page)
        try:
            return self._first_frame(page, _SAMPLES_S)
        finally:
            self._loop.remove(page)

    def _first_frame(self, page: Page, samples_s: float) -> ls.Frame | None:
        """What a page shows; if that is nothing yet, its first frame at rest, with the samples of some more seconds."""
        if page.frame is None:
            self._wait(lambda: page.frames_at_rest > 0 or page.is_finished, _FRAME_S)
            self._wait(lambda: page.is_finished, samples_s)
        return page.frame

    def _wait(self, holds: Callable[[], bool], seconds: float) -> None:
        changed: threading.Condition = self._session.changed
        with changed:
            changed.wait_for(holds, seconds)


class _NullScreen:
    """A screen that nobody looks at: the page's frame is what is wanted."""

    def show(self, shown: ScreenImage) -> None:
        """Is done at once."""

    def close(self) -> None:
        """There is no wait to end."""


WIDTH, HEIGHT = 640, 360
"""Of the frame in the notebook at first, pixels of the page."""
_LINK = '<a href="{}" target="_blank" style="text-decoration: underline">open the page</a>'


class Cell:
    """A frame, and below it a line: the address of the page, and what a click has found.

    All cells that show it are views of it, from the same place.

    Args:
        session: What it shows.
        loop: Renders for it.
        orbit: Where it looks from at first.
        url: The address of the page.

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
        """What the notebook shows."""
        self.page = Page(CellScreen(self.buffer), session.changed)
        self.notify("")
        session.error_listeners.append(self.notify)
        self._look()
        loop.add(self.page)

    def notify(self, note: str) -> None:
        """Shows a note in the line, beside the address while there is a page."""
        link = _LINK.format(html.escape(self._url)) if self.page.is_open else ""
        self._line.value = " · ".join(part for part in (link, html.escape(note)) if part)

    def close(self) -> None:
        """Ends the frames; the last one stays in the notebook."""
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
            case "show":  # or shown anew, by a browser that has nothing yet
                self.page.set_pose(None)
                self._look()
            case _:
                self._on_pointer(event)

    def _on_pointer(self, event: dict[str, Any]) -> None:
        click = self._pointer.handle(event)
        self._look()
        if click is None or self.page.frame is None:
            return
        seen = select(self._session, self.page.frame, *click, is_level=not self.page.frames_at_rest)
        self.notify("" if seen is None else f"{seen[0]}: {seen[1]}")

    def _look(self) -> None:
        self.page.set_pose(self._pointer.orbit.pose(self._pointer.aspect))


def import_widgets() -> tuple[Any, Any]:
    """The packages ipywidgets and jupyter_rfb.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    try:
        return import_module("ipywidgets"), import_module("jupyter_rfb")  # whose types are unknown
    except ImportError:
        raise ls.errors.MissingExtraError("live frames in a notebook's cell", "notebook") from None


def frame_buffer(width: int, height: int, on_event: Callable[[dict[str, Any]], None]) -> Any:
    """A widget that shows what `CellScreen` sends.

    Args:
        width: Width in the notebook, pixels of the page; people may drag its corner.
        height: Height likewise.
        on_event: Called with each event, in a thread of the kernel.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    from IPython.utils.capture import capture_output

    _, jupyter_rfb = import_widgets()
    with capture_output(
        stdout=False, stderr=False
    ):  # of the place that it shows for errors of events, an empty line above the frame
        buffer = jupyter_rfb.RemoteFrameBuffer(css_width=f"{width}px", css_height=f"{height}px")
    buffer.handle_event = on_event
    return buffer


class CellScreen:
    """Sends pictures to a widget; its pages answer which one they have drawn.

    A kernel that runs a cell hears no answers: so long, pictures are sent as often as `ANSWER_S` says.

    Args:
        buffer: The widget, of `frame_buffer`; no one else sends frames to it.
    """

    def __init__(self, buffer: Any) -> None:
        self._buffer = buffer
        self._sent = 0
        self._is_there = threading.Event()
        buffer.observe(self._on_answer, names="_frame_feedback")

    def show(self, shown: ScreenImage) -> None:
        """Sends a picture, and waits until it is drawn."""
        self._is_there.clear()
        self._sent += 1
        self._buffer.quality = shown.quality
        self._buffer.send_frame(shown.picture)
        self._is_there.wait(ANSWER_S)

    def close(self) -> None:
        """Ends the wait."""
        self._is_there.set()

    def _on_answer(self, change: Any) -> None:
        if change["new"].get("index", 0) >= self._sent:
            self._is_there.set()


def has_interactive_user() -> bool:
    """Whether somebody can look at a widget: nbconvert and others that run notebooks have a kernel, but no keyboard."""
    kernel = getattr(_shell(), "kernel", None)
    if kernel is None:
        return False
    return bool(kernel.get_parent("shell").get("content", {}).get("allow_stdin", False))


def can_show_images() -> bool:
    """Whether pictures can be shown, which a terminal cannot; whoever asks without a shell can."""
    shell = _shell()
    return shell is None or "image/png" in shell.display_formatter.active_types


def _shell() -> Any:
    """IPython's shell; None: there is none."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        return None
    return get_ipython()
