"""The table of lighting consistency: its arithmetic, its place in the document, and what a clip is measured by."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from bench import relighting_report as report
from bench.relighting_table import ROOT, Place, measure, some_points
from bench.shadow_report import write_section

import lumisplat as ls
from support.scenes.light_room import captured

REDDISH = np.array([1.0, 0.8, 0.6])
"""Light from above, linear; what is around shows it."""


def sphere(center: tuple[float, float, float], radius: float, count: int = 300) -> tuple[np.ndarray, np.ndarray]:
    """Points of a sphere and its outward normals, shape (count, 3) each."""
    normals = np.random.default_rng(0).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return center + radius * normals, normals


@dataclass(frozen=True)
class Ball:
    """A figure of even albedo in a bluish light from the side."""

    def at(self, time_: float, pose: np.ndarray) -> ls.SplatInstance:
        """The same at all times."""
        points, normals = sphere((0.0, 0.0, 0.0), 0.2)
        light = 0.3 + 0.5 * np.maximum(normals @ (1.0, 0.0, 0.0), 0.0)
        gaussians = captured(points, light[:, None] * (0.5, 0.6, 0.7), opacity=0.95)
        return ls.SplatInstance(replace(gaussians, normals=normals), pose)


def below_a_light() -> ls.Scene:
    """Matt balls about the origin in the light of a ceiling that is too far away to count as the neighbourhood."""
    steps = np.linspace(-8.0, 8.0, 33)
    ceiling = np.stack(np.meshgrid(steps, [2.5], steps, indexing="ij"), axis=-1).reshape(-1, 3)
    sets = [captured(ceiling, REDDISH, opacity=0.99, scale=0.4)]
    for x, z in ((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)):
        points, normals = sphere((x, 0.0, z), 0.1)
        sky = 0.5 + 0.5 * normals[:, 1:2]  # Of an even ceiling without end.
        ball = captured(points, 0.5 * sky * REDDISH, opacity=0.95, scale=0.02)
        sets.append(replace(ball, normals=normals))
    return ls.Scene(splats=[ls.SplatInstance(one) for one in sets])


PLACE = Place("test", below_a_light, (0.0, 0.0, 0.0), (0.1, 0.0, 0.0), 1.7, True, (0.0, 0.0, 0.0))


def test_a_row_is_before_after_and_what_was_gained() -> None:
    """Each metric as captured, relit, and by how much it fell: positive if relighting helps; means below."""
    row = {"paa_orig": 0.9, "paa_relit": 0.5, "apf_orig": 0.03, "apf_relit": 0.05, "ncm_orig": 8.0, "ncm_relit": 6.0}
    row |= {"y_orig": 0.3, "y_relit": 0.2}
    other = dict.fromkeys(row, 0.0)
    facts = {"date": "d", "revision": "r", "cpu": "c", "cores": 2, "warp": "w", "frames": 1, "figure": 9, "key": 0.7}
    lines = report.lines(facts, {"one": row | {"seconds": 1.0}, "two": other | {"seconds": 2.0}})
    assert "| one | 0.900 | 0.500 | **0.400** | 0.030 | 0.050 | **-0.020** | 8.00 | 6.00 | **2.00** |" in lines
    assert "| mean | 0.450 | 0.250 | **0.200** | 0.015 | 0.025 | **-0.010** | 4.00 | 3.00 | **1.00** |" in lines
    # The paper's own deltas, table 1, are not stored: they follow.
    assert "| paper: S1 | 0.580 | 0.320 | **0.260** | 0.072 | 0.046 | **0.026** | 7.90 | 5.60 | **2.30** |" in lines
    assert any(line.startswith("| paper: mean | 0.567 | 0.313 | **0.253** |") for line in lines)
    assert "3 s" in lines[0]
    assert "one 0.300 and 0.200, two 0.000 and 0.000" in lines[-1]


def test_the_document_has_the_table_between_its_marks(tmp_path: Path) -> None:
    """In docs/benchmarks.md: what is written replaces the table, and nothing else."""
    before = (ROOT / "docs" / "benchmarks.md").read_text()
    copy = tmp_path / "benchmarks.md"
    copy.write_text(before)
    write_section(copy, "relighting", ["new"], command="bench.relighting_table")
    mark = "<!-- relighting: written by python -m bench.relighting_table -->"
    first, between, last = copy.read_text().split(mark)
    assert between == "\nnew\n"
    assert before.startswith(first + mark) and before.endswith(mark + last)
    assert "paper: mean" in before.split(mark)[1]


@pytest.fixture(scope="module")
def row() -> dict:
    """A clip of one moment."""
    return measure(PLACE, Ball(), 1, "cpu", None)


def test_a_clip_is_measured_by_the_metrics_as_captured(row: dict) -> None:
    """What is called "orig" is the figure as it walks in, against what is near it."""
    ((time_, pose),) = PLACE.moments(1)
    figure = Ball().at(time_, pose)
    around = some_points(
        ls.metrics.LitPoints.of(below_a_light(), around=figure.world_means.mean(axis=0), radius=PLACE.radius)
    )
    points = ls.metrics.LitPoints.of(figure)
    assert row["paa_orig"] == pytest.approx(ls.metrics.paa_y(points, around, radius=PLACE.radius), abs=1e-6)
    assert row["apf_orig"] == pytest.approx(ls.metrics.apf_y(points, around, radius=PLACE.radius), abs=1e-6)
    assert row["ncm_orig"] == pytest.approx(ls.metrics.ncm_ab(points, around, radius=PLACE.radius), abs=1e-6)


def test_relighting_brings_a_figure_nearer_to_its_surroundings(row: dict) -> None:
    """In the light of a ceiling that the surroundings show, too, all three metrics fall."""
    assert row["paa_relit"] < 0.8 * row["paa_orig"]
    assert row["apf_relit"] < 0.8 * row["apf_orig"]
    assert row["ncm_relit"] < 0.8 * row["ncm_orig"]
