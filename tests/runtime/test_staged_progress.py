"""Progress over stages of work, from the costs of finished pieces."""

from __future__ import annotations

import pytest

from lumisplat.progress import StagedProgress


def test_staged_progress_follows_the_expected_costs_of_the_stages() -> None:
    """Pieces before the first stage are not reported; progress waits at the end of a stage, or jumps to it."""
    told: list[tuple[str, float]] = []
    pace = StagedProgress(lambda *now: told.append(now), "work")
    pace.plan({"cheap": 2.0, "free": 0.0, "dear": 8.0})
    pace.add(1.0)
    assert not told
    pace.begin("cheap")
    for _ in range(3):
        pace.add(1.0)
    pace.begin("free")
    pace.add(5.0)
    pace.begin("dear")
    pace.add(4.0)
    assert [label for label, _ in told] == ["work, cheap"] * 4 + ["work, free"] * 2 + ["work, dear"] * 2
    assert [share for _, share in told] == pytest.approx([0.0, 0.1, 0.2, 0.2, 0.2, 0.2, 0.2, 0.6])


def test_staged_progress_stays_below_one() -> None:
    """At the end of the last stage, and with expected costs of 0, progress is still below 1."""
    told: list[float] = []
    pace = StagedProgress(lambda _, share: told.append(share), "work")
    for cost in (1.0, 0.0):
        pace.plan({"all": cost})
        pace.begin("all")
        pace.add(2.0)
    assert told == pytest.approx([0.0, 0.99, 0.0, 0.0])
