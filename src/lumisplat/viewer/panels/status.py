"""Status of the viewer: progress of long steps, image quality, stage times, and notifications."""

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
from lumisplat.viewer.words import page_words

if TYPE_CHECKING:
    import viser


_EVERY_S = 0.25
_FRAMES = 100
"""Number of frames whose times the plot shows."""


@dataclass
class _Line:
    """Status line of one page, shown on that page only."""

    handle: viser.GuiMarkdownHandle
    written: float = 0.0
    """Time at which the line was last updated, seconds of the monotonic clock."""


class StatusPanel:
    """Status line and progress bar, and a folder with stage times and a plot of frame times.

    Args:
        gui: Controls of the pages.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        self._wait = gui.add_html(wait_html("starting", 0.0))
        """HTML message over the image area of all pages; removed when the first image is displayed."""
        self._line = gui.add_markdown("starting")
        self._lines: dict[Page, _Line] = {}
        """Status line of each open page, about the image of that page."""
        self._bar = gui.add_progress_bar(0.0, animated=True)
        self._has_shown = False
        """True once any page has displayed an image; the message `_wait` is then gone."""
        self._took = np.full(_FRAMES, np.nan)

    def add_details(self, gui: viser.GuiApi) -> None:
        """Adds the table of stage times and the plot, in viser's open GUI folder."""
        self._stages = gui.add_markdown("")
        numbers = np.arange(_FRAMES, dtype=np.float64)
        self._plot = gui.add_uplot(
            (numbers, np.zeros(_FRAMES)),
            ({"label": "frame"}, {"label": "ms", "stroke": "#f5a623", "width": 1}),
            title="frame time (ms)",
            scales={"x": {"time": False}},
            height=140,
        )

    def progress(self, label: str, fraction: float) -> None:
        """Shows the progress of a long step, such as loading, until its fraction is 1."""
        self._bar.visible = fraction < 1.0
        self._bar.value = 100.0 * fraction
        self._line.content, self._line.visible = plain(label), fraction < 1.0
        self._wait.content = wait_html(f"preparing: {label}", fraction)
        self._wait.visible = fraction < 1.0 or not self._has_shown

    def levels(self, fraction: float) -> None:
        """Shows the progress of building the captures' levels of detail, 0 to 1."""
        self._line.content = f"preparing levels of detail: {fraction:.0%}"
        self._line.visible = fraction < 1.0

    def open(self, page: Page, gui: viser.GuiApi) -> None:
        """Adds a status line to a page that has opened.

        Args:
            page: The page.
            gui: Controls of that page.
        """
        self._lines[page] = _Line(gui.add_markdown("", order=self._line.order, visible=False))

    def close(self, page: Page) -> None:
        """Removes the status line of a closed page."""
        self._lines.pop(page, None)

    def frame(self, page: Page, step: DetailStep | None, took: float) -> None:
        """Updates a page's status line and the plot after a frame, at most every `_EVERY_S` seconds.

        Args:
            page: Page of the frame.
            step: Detail step of the frame; None for a still view, which has full detail.
            took: Frame time, milliseconds.
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
    """Returns the HTML message over the image area: a label, and a bar for the completed fraction, 0 to 1."""
    return f'<div class="lumi-wait">{html.escape(label)}<i><b style="width:{fraction:.0%}"></b></i></div>'


def frame_line(page: Page, frame: ls.Frame, step: DetailStep | None, took: float) -> str:
    """Returns a page's status line: image size, samples, and the error of a still or the time of a moving view.

    Args:
        page: Page of the frame.
        frame: The frame.
        step: Detail step of the frame; None for a still view.
        took: Frame time, milliseconds.
    """
    parts = [f"{frame.camera.width} × {frame.camera.height}"]
    if step is not None and step.level and frame.stats is not None and frame.stats.gaussian_count:
        parts.append(f"{frame.stats.gaussian_count:,} Gaussians")
    elif frame.config is not None and frame.config.pipeline.is_sequence and page.frames_at_rest:
        parts.append(f"{page.frames_at_rest} frame{'s' * (page.frames_at_rest != 1)}")
    elif frame.samples:
        parts.append(f"{frame.samples:,} sample{'s' * (frame.samples != 1)}")
    parts.append(f"{took:.0f} ms" if page.noise is None else f"error {page.noise:.1%}")
    return " · ".join(parts)


def stage_table(stats: Any) -> str:
    """Returns the ten longest render stages of a frame, with their times, as a Markdown table."""
    rows = sorted(stats.stage_ms.items(), key=lambda item: -item[1])[:10]
    lines = ["| stage | ms |", "| --- | ---: |", *(f"| {name} | {ms:.1f} |" for name, ms in rows)]
    return "\n".join([*lines, f"| visible Gaussians | {stats.visible_count:,} |"])


QUIET_LOG = logging.getLogger("lumisplat.pages")
"""Logger for messages that appear in the terminal but not as notifications on pages."""
_LOG = logging.getLogger("lumisplat")

_SHOWN_S = 8.0
_AGAIN_S = 2.0
"""Time within which a repetition of the last message is not shown again, seconds."""
_WAITING_MAX = 10
"""Largest number of notifications kept while no page is open; the oldest are dropped."""


class Notifications:
    """Shows notifications on all pages for a few seconds; while no page is open, keeps them for the next one.

    Args:
        server: Server of the pages.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._last: tuple[str, str] | None = None
        self._shown_at = 0.0
        self._waiting: deque[tuple[str, str, bool]] = deque(maxlen=_WAITING_MAX)
        # A filter, because a handler would disable the output to the terminal that logging has without handlers.
        _LOG.addFilter(self._show_warning)

    def notify(self, title: str, body: str, *, is_problem: bool = False) -> None:
        """Shows a notification on all pages, highlighted as an error if ``is_problem``."""
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
        """Shows an error on all pages."""
        self.notify("error", body, is_problem=True)

    def open(self, client: viser.ClientHandle) -> None:
        """Shows the notifications that were kept while no page was open on a new page."""
        while self._waiting:
            title, body, is_problem = self._waiting.popleft()
            _show(client, title, body, is_problem=is_problem)

    def close(self) -> None:
        """Removes the log filter that shows warnings on pages."""
        _LOG.removeFilter(self._show_warning)

    def _show_warning(self, record: logging.LogRecord) -> bool:
        """Log filter: shows warnings on pages as well. Errors are reported to pages where they occur."""
        if record.levelno == logging.WARNING:
            self.notify("warning", page_words(record.getMessage()))
        return True


def _show(client: viser.ClientHandle, title: str, body: str, *, is_problem: bool) -> None:
    with contextlib.suppress(RuntimeError):  # the page has just closed
        client.add_notification(title, body, auto_close_seconds=_SHOWN_S, color="red" if is_problem else None)
