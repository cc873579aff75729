"""A viewer as the result of a cell: live frames, a picture for who cannot show these, and a line of text."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection
from typing import Any

import lumisplat as ls
from lumisplat.viewer.frames.first_view import ASPECT, FirstView
from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.frames.picture import Shown
from lumisplat.viewer.notebook.cell import Cell
from lumisplat.viewer.notebook.host import has_people, has_pictures
from lumisplat.viewer.notebook.orbit import Orbit
from lumisplat.viewer.state.session import Session

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
            except ls.MissingExtraError as error:
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
