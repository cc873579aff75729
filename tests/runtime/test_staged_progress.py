"""Progress over stages of work, from the costs of finished pieces."""

from __future__ import annotations

import pytest

from lumisplat.progress import StagedProgress


def test_progress_over_several_stages_is_divided_by_their_expected_costs() -> None:
    """Pieces before the first stage are not reported; progress waits at the end of a stage, or jumps to it."""
    reports: list[tuple[str, float]] = []
    progress = StagedProgress(lambda *now: reports.append(now), "work")
    progress.plan({"cheap": 2.0, "free": 0.0, "expensive": 8.0})
    progress.add(1.0)
    assert not reports
    progress.begin("cheap")
    for _ in range(3):
        progress.add(1.0)
    progress.begin("free")
    progress.add(5.0)
    progress.begin("expensive")
    progress.add(4.0)
    assert [label for label, _ in reports] == ["work, cheap"] * 4 + ["work, free"] * 2 + ["work, expensive"] * 2
    assert [share for _, share in reports] == pytest.approx([0.0, 0.1, 0.2, 0.2, 0.2, 0.2, 0.2, 0.6])


def test_progress_over_several_stages_stays_below_one() -> None:
    """At the end of the last stage, and with expected costs of 0, progress is still below 1."""
    reports: list[float] = []
    progress = StagedProgress(lambda _, share: reports.append(share), "work")
    for cost in (1.0, 0.0):
        progress.plan({"all": cost})
        progress.begin("all")
        progress.add(2.0)
    assert reports == pytest.approx([0.0, 0.99, 0.0, 0.0])
