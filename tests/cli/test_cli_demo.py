"""Tests ``lumisplat demo``: its files and images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image, ImageSequence
from PIL.GifImagePlugin import GifImageFile

import lumisplat as ls
from lumisplat.demo.moving import moving_scene
from support.files.cli_files import Workspace
from support.files.image_files import read_image


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def test_demo_command_writes_an_image_for_each_camera_and_lit_images_beside_them(work, monkeypatch):
    """On request, demo writes a capture and cameras that can be rendered; the moving room has none."""
    capture = ls.SplatInstance(work.capture("capture.ply"), material=ls.MaterialPbr())
    lights = (
        ls.LightSpot((2.0, -3.0, 1.0), (-1.0, 3.0, 2.0), intensity=300.0, name="spot"),
        ls.LightPoint((0.0, -1.0, 2.0), radius=0.2, name="lamp"),
        ls.LightEnvironment(intensity=0.1, visible=False, name="sky"),
    )
    monkeypatch.setattr(ls, "demo_scene", lambda report: ls.Scene(splats=[replace(capture, material=None)]))
    monkeypatch.setattr(ls, "demo_scene_lit", lambda scene: ls.Scene(splats=[capture], lights=lights))
    monkeypatch.setattr(ls, "demo_cameras", lambda: ls.load_cameras(work.path("cameras.json")))
    line = ("demo", "-o", "@demo", "--save-assets", "--width", "64")
    refused = work.run(*line, "--scene", "moving")
    assert "--save-assets writes the still room: leave out --scene moving" in refused.err
    assert refused.status == 2 and not work.path("demo").exists()
    outcome = work.run(*line)
    assert outcome.status == 0
    images = {"left.png", "right.png"}
    lit = {"lit-raster.png", "lit-trace.png", "lit-hybrid.png", "lit-aovs.png", "lit-swing.gif"}
    assert {path.name for path in work.path("demo").iterdir()} == images | lit | {"demo.ply", "transforms.json"}
    assert {Path(line).name for line in outcome.out.split()} == images | lit
    args = ("render", "@demo/demo.ply", "--cameras", "@demo/transforms.json", "--frames", "left", "--width", "64")
    assert work.run(*args, "-o", "@again.png").status == 0
    first, again = (read_image(work.path(name))["srgb"] for name in ("demo/left.png", "again.png"))
    assert np.abs(first.astype(int) - again).max() <= 1
    with Image.open(work.path("demo/lit-swing.gif")) as swing:
        assert isinstance(swing, GifImageFile)
        assert (swing.size, swing.n_frames) == ((16, swing.height), 24)
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(swing)]
    # The light moves there and back, so the second half shows the frames of the first in reverse.
    assert all(np.array_equal(frames[k], frames[24 - k]) for k in range(1, 12))
    assert np.abs(frames[0].astype(int) - frames[12]).max() > 20
    pipelines = [read_image(work.path(f"demo/lit-{name}.png"))["srgb"] for name in ("raster", "trace", "hybrid")]
    assert read_image(work.path("demo/lit-aovs.png"))["srgb"].shape == (48, 64, 3)
    np.testing.assert_array_equal(pipelines[0], pipelines[2])  # no surface reflects, so raster and hybrid agree
    assert pipelines[1].mean() > 10.0
    assert not np.array_equal(pipelines[1], pipelines[2])  # thick Gaussians look different along rays


def test_demo_command_writes_an_animation_of_the_moving_room(work, monkeypatch):
    """``--scene moving`` writes 48 frames in which light and figure move, and the one in the middle."""
    monkeypatch.setattr("lumisplat.demo.moving.moving_scene", lambda time: moving_scene(time, 3_000))
    outcome = work.run("demo", "-o", "@demo", "--scene", "moving", "--width", "128")
    assert outcome.status == 0
    assert {Path(line).name for line in outcome.out.split()} == {"moving.png", "moving.webp"}
    with Image.open(work.path("demo/moving.webp")) as film:
        assert (film.size, getattr(film, "n_frames", 0)) == ((32, 18), 48)
        frames = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(film)]
    assert min(frame.mean() for frame in frames) > 40.0
    assert np.abs(frames[0] - frames[-1]).max() > 60
