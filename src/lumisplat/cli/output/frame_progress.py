"""How far frames are that are rendered one after the other, and how long the others take."""

from __future__ import annotations

import logging
import time

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted, spoken_time

_log = logging.getLogger("lumisplat")

_LONG_S = 60.0
"""Frames that take longer than this together are announced, seconds."""


class FrameProgress:
    """A bar for all frames, and a line to the log if they take more than a minute: how long, and what is quicker.

    Args:
        report: Shows the bar.
        label: What is being done.
        count: How many frames there are.
        fewer: The options that make them fewer, as they are typed; none: they are parts, and all are needed.
        unit: What one of them is called.
    """

    def __init__(self, report: Report, label: str, count: int, fewer: str, unit: str = "frame") -> None:
        self._report, self._label, self._count, self._fewer, self._unit = report, label, count, fewer, unit
        self._done, self._since = 0, time.monotonic()
        report(label, 0.0)

    def add(self, frame: ls.Frame | ls.SamplePart | None) -> None:
        """Counts a frame that has been rendered and written; None: another process has done that."""
        before, self._since = self._since, time.monotonic()
        self._done += 1
        if self._done == 2:  # the first may have waited for kernels that compile once, and for the scene's upload
            self._announce(self._since - before, 1 if frame is None else frame.samples)
        self._report(self._label, self._done / self._count)

    def _announce(self, seconds: float, samples: int) -> None:
        """Logs how long the frames that are left take, of so many seconds each."""
        left = self._count - self._done
        if left * seconds > _LONG_S:
            remedies = [f"fewer frames ({self._fewer})"] * bool(self._fewer) + ["--samples 1"] * (samples > 1)
            _log.warning(
                "%s to go, about %s: quicker with %s",
                counted(left, self._unit),
                spoken_time(left * seconds),
                " or ".join([", ".join(remedies)] * bool(remedies) + ["a smaller --width"]),
            )
