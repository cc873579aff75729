"""Tests ``raster.projection`` with lenses that only rays can render."""

from __future__ import annotations

import json

import numpy as np
import pytest

import lumisplat as ls
from support.files.cli_files import Workspace
from support.kinds import expect_kind
from support.scenes.raster_scenes import random_gaussians

FISHEYE = {
    "camera_model": "OPENCV_FISHEYE",
    **{"w": 40, "h": 30, "fl_x": 20.0, "fl_y": 20.0, "cx": 20.0, "cy": 15.0, "k1": -0.01},
    "frames": [{"file_path": "one.png", "transform_matrix": np.diag([1.0, -1.0, -1.0, 1.0]).tolist()}],
}


@pytest.fixture
def work(tmp_path, capsys) -> Workspace:
    """Returns a folder to run commands in."""
    return Workspace(tmp_path, capsys)


def test_unscented_projection_renders_fisheyes_by_the_raster_pipeline(work):
    """The image equals the library's; without the setting, the error names the setting."""
    ls.save(work.folder / "a.ply", random_gaussians(3, count=30))
    (work.folder / "fisheye.json").write_text(json.dumps(FISHEYE))
    shown = ("render", "@a.ply", "--cameras", "@fisheye.json", "-o", "@a.npz", "--device", "cpu")
    refused = work.run(*shown)
    assert refused.status == 2
    assert (
        "is fisheye, which --pipeline raster cannot draw: use --set raster.projection=unscented or --pipeline trace"
        in refused.err
    )
    assert work.run(*shown, "--set=raster.projection=unscented").status == 0
    (camera,) = ls.load_cameras(work.folder / "fisheye.json")
    config = ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED))
    capture = expect_kind(ls.Gaussians, ls.load(work.folder / "a.ply"))
    frame = ls.render(ls.Scene([capture]), camera, config, device="cpu")
    with np.load(work.folder / "a.npz") as file:
        np.testing.assert_array_equal(file["color"], frame.color)
    assert frame.alpha.max() > 0.3


def test_unscented_projection_is_logged_as_unused_by_other_pipelines(work, caplog):
    """The stochastic raster strategy excludes this projection and is refused."""
    ls.save(work.folder / "a.ply", random_gaussians(3, count=3))
    small = ("--width", "8", "--height", "6", "--device", "cpu")
    work.run("render", "@a.ply", "-o", "@a.png", *small, "--pipeline", "trace", "--set=raster.projection=unscented")
    assert "not used: --set raster.projection" in caplog.text
    refused = work.run(
        "render", "@a.ply", "-o", "@a.png", "--set=raster.strategy=stochastic", "--set=raster.projection=unscented"
    )
    assert refused.status == 2
    assert "--set raster.strategy=stochastic does not work with --set raster.projection=unscented" in refused.err
