"""How long computations say what they do."""

from __future__ import annotations

from collections.abc import Callable, Mapping

_NEARLY = 0.99
"""Of work that is not done."""

Progress = Callable[[str, float], None]
"""Called with a label of the work and the fraction done, 0..1."""


def say_nothing(label: str, fraction: float) -> None:
    """Progress that nobody asked for."""


class Pace:
    """How far work is whose stages consist of pieces: what each stage is expected to cost, and what pieces cost.

    A stage that costs less than expected is jumped over, one that costs more waits at its end.

    Args:
        report: Called with label and stage, "label, stage", and the fraction done, below 1.
        label: Of the work.
    """

    def __init__(self, report: Progress, label: str) -> None:
        self._report, self._label = report, label
        self._stages: dict[str, float] = {}
        self._before, self._stage, self._done = 0.0, "", 0.0

    def plan(self, stages: Mapping[str, float]) -> None:
        """Says what stages there are, in their order, and what each is expected to cost."""
        self._stages = dict(stages)

    def begin(self, stage: str) -> None:
        """Begins one of the stages."""
        names = list(self._stages)
        self._before = sum(self._stages[name] for name in names[: names.index(stage)])
        self._stage, self._done = stage, 0.0
        self.add(0.0)

    def add(self, cost: float) -> None:
        """Tells of a piece that is done; before stages begin, nothing is told."""
        if not self._stage:
            return
        self._done += cost
        done = self._before + min(self._done, self._stages[self._stage])
        self._report(f"{self._label}, {self._stage}", min(done / max(sum(self._stages.values()), 1e-9), _NEARLY))
