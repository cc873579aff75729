"""The examples run unchanged."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.scene.ops.mesh_sampling import gaussians_from_mesh
from support.files.rig_files import BEND, TubeRig
from support.kinds import expect_kind
from support.scenes.raster_scenes import random_gaussians

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples").glob("*.py"))
LONG = {
    "avatar_in_capture": {"width": 48},
    "bake_light": {"width": 48, "count": 100, "samples": 2},
    "build_while_watched": {"steps": 2, "pause": 0.0, "stays": False},
    "light_a_capture": {"width": 48, "samples": 1},
    "realtime_room": {"width": 48, "frames": 2, "warm_up": 1},
    "drop_in_capture": {"width": 48, "samples": 1},
    "insert_a_mesh": {"width": 48},
    "mirror_and_glass": {"width": 48, "samples": 1},
    "lights_from_an_image": {"width": 48, "samples": 2, "size": 32},
    "relight_a_figure": {"width": 48, "count": 2000},
}
"""Slow examples, with arguments that make their frames small."""
TAKES_A_CAPTURE = ("compose_scene", "points_from_depth", "turntable")


@pytest.mark.parametrize("name", TAKES_A_CAPTURE)
def test_example_without_arguments_prints_its_usage(name, monkeypatch):
    """The program ends with one line of usage."""
    (example,) = (path for path in EXAMPLES if path.stem == name)
    monkeypatch.setattr("sys.argv", [str(example)])
    with pytest.raises(SystemExit, match=f"usage: python examples/{name}.py CAPTURE"):
        runpy.run_path(str(example), run_name="__main__")


@pytest.fixture
def demo_is_ready(demo, monkeypatch):
    """Gives examples the demo scene of the session."""
    monkeypatch.setattr(ls, "demo_scene", lambda: demo)


@pytest.mark.parametrize("name", LONG)
def test_long_example_runs_with_small_frames_and_few_gaussians(name, tmp_path, monkeypatch, demo_is_ready):
    """The example writes a file to out/."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ls, "gaussians_from_mesh", lambda mesh, count: gaussians_from_mesh(mesh, min(count, 500)))
    (example,) = (path for path in EXAMPLES if path.stem == name)
    monkeypatch.setattr("sys.argv", [str(example)])
    runpy.run_path(str(example))["main"](**LONG[name])
    assert any((tmp_path / "out").rglob("*.*"))


@pytest.mark.parametrize(
    "example",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.deep] if path.stem in LONG else []) for path in EXAMPLES],
)
def test_example_program_runs_and_writes_a_file(example, tmp_path, monkeypatch, demo_is_ready):
    """The file is in out/."""
    monkeypatch.chdir(tmp_path)
    ls.save("capture.ply", random_gaussians(1, count=200))
    arguments = ["capture.ply"] if example.stem in TAKES_A_CAPTURE else []
    monkeypatch.setattr("sys.argv", [str(example), *arguments])
    runpy.run_path(str(example), run_name="__main__")
    assert any((tmp_path / "out").rglob("*.*"))


def test_rig_of_the_avatar_example_stands_on_the_floor(tmp_path, monkeypatch):
    """Its lowest point has height 0 at time 0."""
    rig = TubeRig(clips={"bend": BEND})
    path = rig.write(tmp_path / "tube.glb")
    (example,) = (path for path in EXAMPLES if path.stem == "avatar_in_capture")
    monkeypatch.setattr("sys.argv", [str(example), str(path)])
    names = runpy.run_path(str(example))
    subject = names["figure"]()
    assert isinstance(subject, ls.RiggedGaussians)
    (instance,) = ls.Actor(subject, world_from_object=names["on_the_floor"](subject)).at(0.0)
    heights = expect_kind(ls.SplatInstance, instance).gaussians.means[:, 1] + instance.transform[1, 3]
    assert subject.at(0.0).means[:, 1].min() != 0.0
    np.testing.assert_allclose(heights.min(), 0.0, atol=1e-6)
