"""What is counted as found: lights at lamps, lamps with a light, degrees between suns."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from bench import lights_found

import lumisplat as ls
from support.scenes.lit_captures import LitCapture

FOUND = [(0.0, 2.0, 0.0), (3.0, 2.0, 0.0)]
"""Where a search says that there are lamps."""


def searched(monkeypatch: pytest.MonkeyPatch, lamps: list[tuple[float, float, float]], unit: float) -> dict:
    """The row of a capture in which two lights and a sun from +x are found; the true sun is 30 degrees off."""
    lights = [ls.LightPoint(place) for place in FOUND]
    estimate = SimpleNamespace(lights=lights, evidence=np.array([0.3, 0.2]))
    sun = SimpleNamespace(light=ls.LightDirectional((-1.0, 0.0, 0.0)), confidence=0.5)
    monkeypatch.setattr(ls.inverse, "estimate_lights", lambda *_: estimate)
    monkeypatch.setattr(ls.inverse, "estimate_sun", lambda *_: sun)
    towards = np.array([np.cos(np.pi / 6.0), np.sin(np.pi / 6.0), 0.0])
    return lights_found.found_lights(LitCapture("room 1", ls.Scene(), np.zeros(3), np.array(lamps), towards, unit))


def test_lights_count_where_a_lamp_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 0.4 m of one, in the capture's own unit; a lamp that two lights are at is found once."""
    row = searched(monkeypatch, [(0.3, 2.0, 0.0), (0.0, 0.0, 3.0), (9.0, 0.0, 0.0)], 1.0)
    assert (row["lamps"], row["lamps_found"], row["lights"], row["lights_right"]) == (3, 1, 2, 1)
    assert searched(monkeypatch, [(0.3, 2.0, 0.0)], 0.5)["lights_right"] == 0
    both = searched(monkeypatch, [(1.5, 2.0, 0.0)], 4.0)
    assert (both["lamps_found"], both["lights_right"]) == (1, 2)


def test_the_table_sums_a_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers are added over captures of a kind; of the suns' errors the median and the worst are given."""
    rows = [searched(monkeypatch, [(0.3, 2.0, 0.0)], 1.0) for _ in range(2)]
    assert rows[0]["degrees_off"] == pytest.approx(30.0, abs=0.1)
    assert lights_found.table(rows)[2:] == ["| room | 2 | 2 | 2 | 4 | 2 | 2 | 2 | 30.0 (at most 30.0) |"]


def test_nothing_found_is_counted_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error is no light, and no sun is none."""

    def nothing(*_: object) -> None:
        raise ls.SceneError("no lamp found within 3 of (0, 0, 0)")

    monkeypatch.setattr(ls.inverse, "estimate_lights", nothing)
    monkeypatch.setattr(ls.inverse, "estimate_sun", lambda *_: None)
    capture = LitCapture("night 1", ls.Scene(), np.zeros(3), np.zeros((1, 3)), None, 1.0)
    row = lights_found.found_lights(capture)
    assert (row["lamps"], row["lamps_found"], row["lights"], row["sun_found"]) == (1, 0, 0, False)
    assert row["degrees_off"] is None and row["says"] == "no lamp found "
