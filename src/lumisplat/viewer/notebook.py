"""Shows a viewer as the result of a notebook's cell: live frames, an image where these cannot run, and a text."""

from __future__ import annotations

import html
import logging
import threading
from collections.abc import Callable, Collection
from importlib import import_module
from typing import Any

import lumisplat as ls
from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.page import Page, Shown
from lumisplat.viewer.frames.pose import ASPECT, FirstView
from lumisplat.viewer.gizmos_and_picking.picking import select
from lumisplat.viewer.orbit import Hand, Orbit
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.thresholds import ANSWER_S

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
        if any(map(is_wanted, ("image/png", "image/jpeg"))) and has_pictures():
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
        if not has_people():
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
        page = Page(_Nowhere(), self._session.changed)
        page.look(orbit.pose(ASPECT))
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


class _Nowhere:
    """A screen that nobody looks at: the page's frame is what is wanted."""

    def show(self, shown: Shown) -> None:
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
        self._hand = Hand(orbit, session.extent.size, WIDTH, HEIGHT)
        self.buffer = frame_buffer(WIDTH, HEIGHT, self._on_event)
        self._line = ipywidgets.HTML()
        self.widget = ipywidgets.VBox([self.buffer, self._line])
        """What the notebook shows."""
        self.page = Page(CellScreen(self.buffer), session.changed)
        self.tell("")
        session.errors.append(self.tell)
        self._look()
        loop.add(self.page)

    def tell(self, note: str) -> None:
        """Shows a note in the line, beside the address while there is a page."""
        link = _LINK.format(html.escape(self._url)) if self.page.is_open else ""
        self._line.value = " · ".join(part for part in (link, html.escape(note)) if part)

    def close(self) -> None:
        """Ends the frames; the last one stays in the notebook."""
        if not self.page.is_open:
            return
        self._session.errors.remove(self.tell)
        self._loop.remove(self.page)
        self.tell("closed")

    def _on_event(self, event: dict[str, Any]) -> None:
        match event["type"]:
            case "close":
                self.close()
            case "hide":
                self.page.look(None)
            case "show":  # or shown anew, by a browser that has nothing yet
                self.page.look(None)
                self._look()
            case _:
                self._on_hand(event)

    def _on_hand(self, event: dict[str, Any]) -> None:
        click = self._hand.feel(event)
        self._look()
        if click is None or self.page.frame is None:
            return
        seen = select(self._session, self.page.frame, *click, is_level=not self.page.frames_at_rest)
        self.tell("" if seen is None else f"{seen[0]}: {seen[1]}")

    def _look(self) -> None:
        self.page.look(self._hand.orbit.pose(self._hand.aspect))


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

    def show(self, shown: Shown) -> None:
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


def has_people() -> bool:
    """Whether somebody can look at a widget: nbconvert and others that run notebooks have a kernel, but no keyboard."""
    kernel = getattr(_shell(), "kernel", None)
    if kernel is None:
        return False
    return bool(kernel.get_parent("shell").get("content", {}).get("allow_stdin", False))


def has_pictures() -> bool:
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
