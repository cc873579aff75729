"""Scores of estimated lights: lights near true ones, true lights found, and angles between suns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from bench import lights_found

import lumisplat as ls
from support.scenes.lit_captures import LitCapture

FOUND = [(0.0, 2.0, 0.0), (3.0, 2.0, 0.0)]
"""Positions of the estimated lights."""


def searched(monkeypatch: pytest.MonkeyPatch, light_positions: list[tuple[float, float, float]], unit: float) -> dict:
    """Returns the score of a capture with two estimated lights and a sun from +x; the true sun is 30 degrees off."""
    lights = [ls.LightPoint(position) for position in FOUND]
    estimate = SimpleNamespace(lights=lights, evidence=np.array([0.3, 0.2]))
    sun = SimpleNamespace(light=ls.LightDirectional((-1.0, 0.0, 0.0)), confidence=0.5)
    monkeypatch.setattr(ls.inverse, "estimate_lights", lambda *_: estimate)
    monkeypatch.setattr(ls.inverse, "estimate_sun", lambda *_: sun)
    towards = np.array([np.cos(np.pi / 6.0), np.sin(np.pi / 6.0), 0.0])
    return lights_found.found_lights(
        LitCapture("room 1", ls.Scene(), np.zeros(3), np.array(light_positions), towards, unit)
    )


def test_light_benchmark_counts_an_estimate_as_correct_only_near_a_true_light(monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is 0.4 m in the capture's own unit; a true light with two estimates counts as found once."""
    row = searched(monkeypatch, [(0.3, 2.0, 0.0), (0.0, 0.0, 3.0), (9.0, 0.0, 0.0)], 1.0)
    assert (row["lamps"], row["lamps_found"], row["lights"], row["lights_right"]) == (3, 1, 2, 1)
    assert searched(monkeypatch, [(0.3, 2.0, 0.0)], 0.5)["lights_right"] == 0
    both = searched(monkeypatch, [(1.5, 2.0, 0.0)], 4.0)
    assert (both["lamps_found"], both["lights_right"]) == (1, 2)


def test_light_benchmark_table_adds_up_counts_of_captures_of_the_same_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counts are summed; sun errors give the median and the maximum."""
    rows = [searched(monkeypatch, [(0.3, 2.0, 0.0)], 1.0) for _ in range(2)]
    assert rows[0]["degrees_off"] == pytest.approx(30.0, abs=0.1)
    assert lights_found.table(rows)[2:] == ["| room | 2 | 2 | 2 | 4 | 2 | 2 | 2 | 30.0 (at most 30.0) |"]


def test_light_benchmark_counts_a_failed_estimate_as_no_light_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error gives no light, and None gives no sun."""

    def nothing(*_: object) -> None:
        raise ls.SceneError("no lamp found within 3 of (0, 0, 0)")

    monkeypatch.setattr(ls.inverse, "estimate_lights", nothing)
    monkeypatch.setattr(ls.inverse, "estimate_sun", lambda *_: None)
    capture = LitCapture("night 1", ls.Scene(), np.zeros(3), np.zeros((1, 3)), None, 1.0)
    row = lights_found.found_lights(capture)
    assert (row["lamps"], row["lamps_found"], row["lights"], row["sun_found"]) == (1, 0, 0, False)
    assert row["degrees_off"] is None and row["says"] == "no lamp found "
