"""What is being done: progress, how fine the picture is, where the time goes."""

from __future__ import annotations

import html
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pace import Step
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.panels.buttons import plain
from lumisplat.viewer.thresholds import LEVEL_FRACTIONS

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

    def frame(self, page: Page, step: Step | None, took: float) -> None:
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


def frame_line(page: Page, frame: ls.Frame, step: Step | None, took: float) -> str:
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
