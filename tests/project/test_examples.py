"""The examples run as they are."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.files.rig_files import BEND, TubeRig
from support.scenes.raster_scenes import random_gaussians

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("*.py"))
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


def test_a_walking_figure_stands_on_the_floor(tmp_path, monkeypatch):
    """A rig begins with its lowest point at height 0."""
    rig = TubeRig(clips={"bend": BEND})
    path = rig.write(tmp_path / "tube.glb")
    (example,) = (path for path in EXAMPLES if path.stem == "avatar_in_capture")
    monkeypatch.setattr("sys.argv", [str(example), str(path)])
    names = runpy.run_path(str(example))
    subject = names["figure"]()
    assert isinstance(subject, ls.RiggedGaussians)
    (instance,) = ls.Actor(subject, world_from_object=names["on_the_floor"](subject)).at(0.0)
    heights = instance.gaussians.means[:, 1] + instance.transform[1, 3]
    assert subject.at(0.0).means[:, 1].min() != 0.0
    np.testing.assert_allclose(heights.min(), 0.0, atol=1e-6)
