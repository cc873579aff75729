"""Progress reports of long computations."""

from __future__ import annotations

from collections.abc import Callable, Mapping

_NEARLY = 0.99
"""Largest fraction that is reported before the work is done."""

Progress = Callable[[str, float], None]
"""Callback that receives a label of the work and the fraction done, 0..1."""


def no_progress(label: str, fraction: float) -> None:
    """Ignores progress: the default callback."""


class StagedProgress:
    """Progress of work that consists of stages, from their expected costs and the costs of finished pieces.

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
        """Sets the stages in their order, and the expected cost of each."""
        self._stages = dict(stages)

    def begin(self, stage: str) -> None:
        """Begins a stage."""
        names = list(self._stages)
        self._before = sum(self._stages[name] for name in names[: names.index(stage)])
        self._stage, self._done = stage, 0.0
        self.add(0.0)

    def add(self, cost: float) -> None:
        """Reports the cost of a finished piece; does nothing before the first stage begins."""
        if not self._stage:
            return
        self._done += cost
        done = self._before + min(self._done, self._stages[self._stage])
        self._report(f"{self._label}, {self._stage}", min(done / max(sum(self._stages.values()), 1e-9), _NEARLY))
