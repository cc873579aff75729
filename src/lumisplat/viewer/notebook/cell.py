"""Live frames in a notebook: one more page of the session, turned by the mouse in its cell."""

from __future__ import annotations

import html
from typing import Any

from lumisplat.viewer.frames.loop import RenderLoop
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.hands.picking import select
from lumisplat.viewer.notebook.frame_buffer import CellScreen, frame_buffer, import_widgets
from lumisplat.viewer.notebook.hand import Hand
from lumisplat.viewer.notebook.orbit import Orbit
from lumisplat.viewer.state.session import Session

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
