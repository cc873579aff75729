"""The examples run as they are."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

import lumisplat as ls
from scenes import random_gaussians

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
TAKES_A_CAPTURE = ("compose_scene", "points_from_depth", "turntable")


@pytest.mark.parametrize("name", TAKES_A_CAPTURE)
def test_example_says_what_it_takes(name, monkeypatch):
    """Without its argument, an example ends with a line on how to call it."""
    (example,) = (path for path in EXAMPLES if path.stem == name)
    monkeypatch.setattr("sys.argv", [str(example)])
    with pytest.raises(SystemExit, match=f"usage: python examples/{name}.py CAPTURE"):
        runpy.run_path(str(example), run_name="__main__")


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(example, tmp_path, monkeypatch):
    """An example ends without an error and leaves a file in out/."""
    monkeypatch.chdir(tmp_path)
    ls.save("capture.ply", random_gaussians(1, count=200))
    arguments = ["capture.ply"] if example.stem in TAKES_A_CAPTURE else []
    monkeypatch.setattr("sys.argv", [str(example), *arguments])
    runpy.run_path(str(example), run_name="__main__")
    assert any((tmp_path / "out").rglob("*.*"))
