"""Tests ``lumisplat dataset`` and ``lumisplat farm dataset``: continued views, equal files, and mistakes."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest
import warp as wp

from lumisplat.io.images.exr import write_exr
from support.files.cli_files import Workspace

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")
SETTINGS = """
layers = ["depth", "instance"]

[poses]
seen = 0.0

[objects]
files = ["cone.obj"]
size = 0.05
"""
SCENE = """
[[meshes]]
shape = "plane"
size = [4.0, 4.0]
name = "floor"

[[splats]]
path = "capture.ply"
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    workspace = Workspace(tmp_path, capsys)
    workspace.path("set.toml").write_text(SETTINGS)
    workspace.path("scene.toml").write_text(SCENE)
    workspace.path("cone.obj").write_text("v -1 0 -1\nv 1 0 -1\nv 0 0 1\nv 0 1 0\nf 1 2 3\nf 1 4 2\nf 2 4 3\nf 3 4 1\n")
    return workspace


def contents(work: Workspace, folder: str) -> dict[str, bytes]:
    """Returns the content of all files of a folder."""
    root = work.path(folder)
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("[!.]*")) if path.is_file()}


def make(work: Workspace, folder: str, *options: str, farm: bool = False):
    """Renders views of the scene."""
    command = ("farm", "dataset") if farm else ("dataset",)
    return work.run(*command, "@scene.toml", "--settings", "@set.toml", "-o", f"@{folder}", *SIZE, *options)


def test_dataset_views_rendered_in_parts_equal_the_whole(work, caplog) -> None:
    """Files are equal bit by bit once all views exist; more views leave existing ones unchanged."""
    whole = make(work, "whole", "--views", "5", "--seed", "7", "--shards", "2")
    assert whole.status == 0, whole.err
    assert "--seed" not in caplog.text  # the poses use it in every pipeline
    assert "5 views in" in whole.out and "transforms.json: " in whole.out and " shards; " in whole.out
    first = make(work, "parts", "--views", "3", "--seed", "7")
    assert first.status == 0 and "transforms.json: " in first.out and not work.path("parts/shards").exists()
    part = make(work, "parts", "--views", "5", "--seed", "7", "--frames", "4")
    assert "1 view is missing: the same command without --frames makes it" in part.out
    done = make(work, "parts", "--views", "5", "--seed", "7", "--shards", "2")
    assert "5 views in" in done.out and "4 of them already existed" in done.out
    assert contents(work, "parts") == contents(work, "whole")
    refused = make(work, "parts", "--views", "5", "--seed", "8")
    assert refused.status == 2 and "holds frames of other settings or files (dataset.seed" in refused.err
    again = make(work, "parts", "--views", "1", "--seed", "8", "--overwrite", "--layers", "none")
    assert again.status == 0 and len(json.loads(work.path("parts/transforms.json").read_text())["frames"]) == 1


@pytest.mark.deep
@pytest.mark.filterwarnings("ignore")
def test_dataset_views_of_a_farm_equal_those_of_one_process(work) -> None:
    """Files of two workers are equal bit by bit, with light and objects; the same command continues."""
    if importlib.util.find_spec("ray") is None:
        pytest.skip("Ray is not installed: pip install 'lumisplat[farm]'")
    assert make(work, "whole", "--views", "4").status == 0
    assert make(work, "farm", "--views", "4", "--frames", "2").status == 0
    done = make(work, "farm", "--views", "4", "--workers", "2", farm=True)
    assert done.status == 0 and "3 views by 2 workers" in done.out, done.err
    assert "1 of them already existed" in done.out and "contact_sheet.png shows the first" in done.out
    assert contents(work, "farm") == contents(work, "whole")


def test_dataset_options_set_cameras_environment_and_exposure(work) -> None:
    """``--cameras`` puts views near its cameras, ``--environment`` is rotated, and ``--exposure`` is added."""
    write_exr(work.path("sky.exr"), dict.fromkeys("RGB", np.ones((2, 4), np.float32)))
    options = ("--cameras", str(work.path("cameras.json")), "--environment", str(work.path("sky.exr")))
    options = (*options, "--exposure", "1.5", "--samples", "1", "--settings", str(work.path("set.toml")))
    done = work.run("dataset", "@capture.ply", "-o", "@near", "--views", "2", *SIZE, *options)
    assert done.status == 0, done.err
    records = [json.loads(work.path(f"near/views/view_00000{index}.json").read_text()) for index in range(2)]
    assert all(np.abs(np.array(record["camera"]["camera_from_world"])[:3, 3]).max() < 0.5 for record in records)
    assert all(record["camera"]["exposure"] == 1.5 for record in records)
    rotations = [record["lights"][-1]["rotation_wxyz"] for record in records]
    assert records[0]["lights"][-1]["name"] == "sky" and rotations[0] != rotations[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--views", "0"), "--views is 0, expected a whole number from 1"),
        (("--layers", "dept"), "layers has 'dept', did you mean 'depth'?"),
        (("--objects", "@lost.glb"), "lost.glb: no such file"),
        (("--settings", "@lost.toml"), "lost.toml: no such file"),
        (("--eye", "1,2,3"), "--eye sets one camera, but views are random"),
        (("--camera-path", "@cameras.json"), "--camera-path sets one camera"),
        (("--pipeline", "realtime"), "--pipeline realtime needs consecutive frames"),
        (("--frames", "100"), "'100' is out of range: there are 100 views, 0-99"),
        (("-o", "-"), "there are several frames: give a folder"),
        (("--layers", "albedo", "--lighting", "off"), "--layers has albedo, which only lit views have"),
        (("--objects", "@cameras.json"), "cameras.json: "),
    ],
)
def test_dataset_command_reports_mistakes_of_the_user_in_one_line(work, options: tuple[str, ...], message: str) -> None:
    """Each mistake ends with status 2, and writes no view."""
    options = tuple(str(work.path(option[1:])) if option.startswith("@") else option for option in options)
    done = work.run("dataset", "@scene.toml", "-o", "@out", *SIZE, *options)
    assert (done.status, done.out) == (2, ""), done.err
    assert message in done.err and done.err.strip().count("\n") == 0
    assert not work.path("out").exists()


def test_dataset_views_placed_near_cameras_require_a_camera_file(work) -> None:
    """The settings place views near cameras, but no file has any."""
    work.path("set.toml").write_text('[poses]\nwhere = "cameras"\n')
    done = make(work, "out")
    assert done.status == 2 and "need cameras: give --cameras FILE" in done.err
