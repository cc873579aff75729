"""Progress reports of long computations."""

from __future__ import annotations

from collections.abc import Callable, Mapping

_NEARLY = 0.99
"""Largest fraction that `StagedProgress` reports, because only the end of the work is 1."""

Progress = Callable[[str, float], None]
"""Callback that receives a description of the current work and the fraction done, 0..1."""


def no_progress(label: str, fraction: float) -> None:
    """Ignores progress: the default callback."""


class StagedProgress:
    """Reports the progress of work in several named stages, from the expected cost of each and the cost done so far.

    If a stage costs less than expected, progress jumps to its end; if it costs more, progress waits there.

    Args:
        report: Called with "label, stage" and the fraction done, below 1.
        label: Label of the work.
    """

    def __init__(self, report: Progress, label: str) -> None:
        self._report, self._label = report, label
        self._stages: dict[str, float] = {}
        self._before, self._stage, self._done = 0.0, "", 0.0

    def plan(self, stages: Mapping[str, float]) -> None:
        """Sets the names of the stages, in order, and the expected cost of each in any common unit."""
        self._stages = dict(stages)

    def begin(self, stage: str) -> None:
        """Begins the planned stage of that name: reports its label, and all earlier stages as done."""
        names = list(self._stages)
        self._before = sum(self._stages[name] for name in names[: names.index(stage)])
        self._stage, self._done = stage, 0.0
        self.add(0.0)

    def add(self, cost: float) -> None:
        """Adds ``cost`` to the cost done in the current stage, and reports progress; does nothing before ``begin``."""
        if not self._stage:
            return
        self._done += cost
        done = self._before + min(self._done, self._stages[self._stage])
        self._report(f"{self._label}, {self._stage}", min(done / max(sum(self._stages.values()), 1e-9), _NEARLY))
