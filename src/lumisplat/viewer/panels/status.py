"""Shows progress, the quality of the image and the time of its stages, and notifications for a while."""

from __future__ import annotations

import contextlib
import html
import logging
import time
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import DetailStep, Page
from lumisplat.viewer.panels.buttons import plain
from lumisplat.viewer.thresholds import LEVEL_FRACTIONS
from lumisplat.viewer.words import page_words

if TYPE_CHECKING:
    import viser


_EVERY_S = 0.25
_FRAMES = 100
"""Frames in the plot."""


@dataclass
class _Line:
    """The line of a page."""

    handle: viser.GuiMarkdownHandle
    written: float = 0.0
    """When it was written last, seconds of the monotonic clock."""


class StatusPanel:
    """A line on top, progress below it, and a folder with stages and a plot.

    Args:
        gui: The pages' controls.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        self._wait = gui.add_html(wait_html("starting", 0.0))
        """Over the picture, until there is one."""
        self._line = gui.add_markdown("starting")
        self._lines: dict[Page, _Line] = {}
        """Of each page: how fine its own picture is."""
        self._bar = gui.add_progress_bar(0.0, animated=True)
        self._has_shown = False
        """Whether some page shows a picture."""
        self._took = np.full(_FRAMES, np.nan)

    def add_details(self, gui: viser.GuiApi) -> None:
        """Adds the table of stages and the plot, in the present folder."""
        self._stages = gui.add_markdown("")
        numbers = np.arange(_FRAMES, dtype=np.float64)
        self._plot = gui.add_uplot(
            (numbers, np.zeros(_FRAMES)),
            ({"label": "frame"}, {"label": "ms", "stroke": "#f5a623", "width": 1}),
            title="milliseconds a frame",
            scales={"x": {"time": False}},
            height=140,
        )

    def progress(self, label: str, fraction: float) -> None:
        """Shows what is being done, until the fraction is 1."""
        self._bar.visible = fraction < 1.0
        self._bar.value = 100.0 * fraction
        self._line.content, self._line.visible = plain(label), fraction < 1.0
        self._wait.content = wait_html(f"preparing: {label}", fraction)
        self._wait.visible = fraction < 1.0 or not self._has_shown

    def levels(self, fraction: float) -> None:
        """Shows how far the levels of a capture are, from which views that move will be drawn."""
        self._line.content = f"preparing levels of detail: {fraction:.0%}"
        self._line.visible = fraction < 1.0

    def open(self, page: Page, gui: viser.GuiApi) -> None:
        """Gives a page a line of its own.

        Args:
            page: The page.
            gui: Its controls.
        """
        self._lines[page] = _Line(gui.add_markdown("", order=self._line.order, visible=False))

    def close(self, page: Page) -> None:
        """Forgets the line of a page that has gone."""
        self._lines.pop(page, None)

    def frame(self, page: Page, step: DetailStep | None, took: float) -> None:
        """Shows what a frame has taken; not more often than people read.

        Args:
            page: Of the frame.
            step: How finely it was drawn; None: at rest.
            took: Milliseconds.
        """
        self._took = np.roll(self._took, -1)
        self._took[-1] = took
        now, line = time.monotonic(), self._lines.get(page)
        if page.frame is None or line is None or (now - line.written < _EVERY_S and not page.is_finished):
            return
        line.written = now
        self._has_shown = True
        if self._wait.visible:
            self._wait.visible = False
        if self._bar.visible:
            self._bar.visible = self._line.visible = False
        line.handle.content, line.handle.visible = frame_line(page, page.frame, step, took), True
        if page.frame.stats is not None:
            self._stages.content = stage_table(page.frame.stats)
        times = np.nan_to_num(self._took)
        self._plot.data = (np.arange(_FRAMES, dtype=np.float64), times)


def wait_html(label: str, fraction: float) -> str:
    """What is shown over the picture while it is prepared: words, and a bar for the share that is done, 0..1."""
    return f'<div class="lumi-wait">{html.escape(label)}<i><b style="width:{fraction:.0%}"></b></i></div>'


def frame_line(page: Page, frame: ls.Frame, step: DetailStep | None, took: float) -> str:
    """How fine the frame of a page is, in a line that fits the panel."""
    parts = [f"{frame.camera.width} × {frame.camera.height}"]
    if step is not None and step.level:
        parts.append(f"{LEVEL_FRACTIONS[step.level]:.0%} of Gaussians")
    elif frame.config is not None and frame.config.pipeline.is_sequence and page.frames_at_rest:
        parts.append(f"{page.frames_at_rest} frame{'s' * (page.frames_at_rest != 1)}")
    elif frame.samples:
        parts.append(f"{frame.samples:,} sample{'s' * (frame.samples != 1)}")
    parts.append(f"{took:.0f} ms" if page.noise is None else f"error {page.noise:.1%}")
    return " · ".join(parts)


def stage_table(stats: Any) -> str:
    """The times of a frame's stages, as a table; the longest first."""
    rows = sorted(stats.stage_ms.items(), key=lambda item: -item[1])[:10]
    lines = ["| stage | ms |", "| --- | ---: |", *(f"| {name} | {ms:.1f} |" for name, ms in rows)]
    return "\n".join([*lines, f"| Gaussians seen | {stats.visible_count:,} |"])


QUIET_LOG = logging.getLogger("lumisplat.pages")
"""For lines that those at the machine read, and pages do not."""
_LOG = logging.getLogger("lumisplat")

_SHOWN_S = 8.0
_AGAIN_S = 2.0
"""A line that comes again and again is told anew after so long a pause."""
_WAITING_MAX = 10
"""Notifications that wait for the first page, at most: the last ones."""


class Notifications:
    """Shows notifications on all pages, for a while. Those that nobody was there for wait for the next page.

    Args:
        server: Has the pages.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._last: tuple[str, str] | None = None
        self._shown_at = 0.0
        self._waiting: deque[tuple[str, str, bool]] = deque(maxlen=_WAITING_MAX)
        # A handler would keep lines off the terminal, where they go as long as there is none.
        _LOG.addFilter(self._show_warning)

    def notify(self, title: str, body: str, *, is_problem: bool = False) -> None:
        """Shows a note on all pages."""
        now, before, self._last = time.monotonic(), self._last, (title, body)
        is_new, self._shown_at = before != self._last or now - self._shown_at > _AGAIN_S, now
        if not is_new:
            return
        clients = list(self._server.get_clients().values())
        for client in clients:
            _show(client, title, body, is_problem=is_problem)
        if not clients:
            self._waiting.append((title, body, is_problem))

    def problem(self, body: str) -> None:
        """Shows why something could not be done."""
        self.notify("that did not work", body, is_problem=True)

    def open(self, client: viser.ClientHandle) -> None:
        """Shows a new page what nobody was there for."""
        while self._waiting:
            title, body, is_problem = self._waiting.popleft()
            _show(client, title, body, is_problem=is_problem)

    def close(self) -> None:
        """Ends with the viewer."""
        _LOG.removeFilter(self._show_warning)

    def _show_warning(self, record: logging.LogRecord) -> bool:
        """Tells pages what is logged of scenes and frames, such as odd colours; errors are told where they happen."""
        if record.levelno == logging.WARNING:
            self.notify("note", page_words(record.getMessage()))
        return True


def _show(client: viser.ClientHandle, title: str, body: str, *, is_problem: bool) -> None:
    with contextlib.suppress(RuntimeError):  # it has just gone
        client.add_notification(title, body, auto_close_seconds=_SHOWN_S, color="red" if is_problem else None)
