"""Tests ``--tiles``: images rendered in parts, by one process or by workers, equal whole renders."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from PIL import Image

from lumisplat.io.images.exr import read_exr
from support.files.cli_files import Workspace

SIZE = ("--width", "70", "--height", "50", "--device", "cpu")
TWO = ("--workers", "2")
CAMERAS = ("--cameras", "@cameras.json")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def pixels(path: Path) -> np.ndarray:
    """Returns the pixels of a PNG."""
    with Image.open(path) as image:
        return np.asarray(image)


def test_image_joined_from_tiles_equals_a_whole_render(work) -> None:
    """PNGs and EXRs with layers are joined, tiles are removed, and nothing is rendered twice."""
    for options in (("--format", "png"), ("--format", "exr", "--aov", "depth,gaussian_index", "--overwrite")):
        again = [option for option in options if option != "--overwrite"]
        assert work.run("render", "@capture.ply", *CAMERAS, "-o", "@whole", *SIZE, *again).status == 0
        done = work.run("render", "@capture.ply", *CAMERAS, "-o", "@tiled", *SIZE, *again, "--tiles", "2x3")
        assert done.status == 0 and "2 images in" in done.out, done.err
    for name in ("left", "right"):
        np.testing.assert_array_equal(pixels(work.path(f"tiled/{name}.png")), pixels(work.path(f"whole/{name}.png")))
        tiled, whole = read_exr(work.path(f"tiled/{name}.exr")), read_exr(work.path(f"whole/{name}.exr"))
        assert tiled.keys() == whole.keys() and "index.gaussian" in tiled
        for channel, image in whole.items():
            np.testing.assert_array_equal(tiled[channel], image)
    assert {path.name for path in work.path("tiled").iterdir()} == {
        "left.png", "right.png", "left.exr", "right.exr", "render.json"
    }  # fmt: skip
    before = work.path("tiled/left.exr").stat().st_mtime_ns
    assert (
        work.run(
            "render", "@capture.ply", *CAMERAS, "-o", "@tiled", *SIZE, *again, "--tiles", "auto", "--resume"
        ).status
        == 0
    )
    assert work.path("tiled/left.exr").stat().st_mtime_ns == before


def test_render_in_tiles_to_a_single_file_joins_them_and_continues_if_interrupted(work) -> None:
    """The same command continues an interrupted render; other settings are refused."""
    options = ("@capture.ply", "-o", "@huge.png", *SIZE)
    assert work.run("render", "@capture.ply", "-o", "@whole.png", *SIZE).status == 0
    done = work.run("render", *options, "--tiles", "2x2", "--resume")
    assert done.status == 0, done.err
    np.testing.assert_array_equal(pixels(work.path("huge.png")), pixels(work.path("whole.png")))
    assert not work.path("huge.tiles").exists() and work.path("huge.render.json").is_file()
    again = work.run("render", *options, "--tiles", "4x1", "--resume")
    assert again.status == 0 and again.out.strip() == str(work.path("huge.png"))
    refused = work.run("render", *options, "--tiles", "2x2", "--resume", "--background", "white")
    assert refused.status == 2 and "other settings or files (background" in refused.err


def test_path_traced_image_rendered_in_tiles_has_the_noise_of_one_rendered_whole(work) -> None:
    """The random numbers of a pixel do not depend on its tile."""
    options = ("@capture.ply", "--pipeline", "path", "--samples", "2", "--lighting", "on", *SIZE)
    assert work.run("render", *options, "-o", "@whole.png").status == 0
    assert work.run("render", *options, "-o", "@tiled.png", "--tiles", "2x2").status == 0
    np.testing.assert_array_equal(pixels(work.path("tiled.png")), pixels(work.path("whole.png")))


def test_render_in_tiles_continues_after_a_killed_process(work, tmp_path: Path) -> None:
    """Existing tiles stay, missing ones are rendered, and the image is the same."""
    command = ["render", str(work.path("capture.ply")), "-o", str(work.path("huge.png")), *SIZE, "--tiles", "1x4"]
    assert work.run("render", "@capture.ply", "-o", "@whole.png", *SIZE).status == 0
    killing = (
        "import os, signal, sys\n"
        "import lumisplat as ls\n"
        "from lumisplat.cli import main\n"
        "save, made = ls.Frame.save, []\n"
        "def counted(frame, *args, **rest):\n"
        "    if len(made) == 2: os.kill(os.getpid(), signal.SIGKILL)\n"
        "    made.append(save(frame, *args, **rest))\n"
        "ls.Frame.save = counted\n"
        "main(sys.argv[1:])\n"
    )
    killed = subprocess.run([sys.executable, "-c", killing, *command], cwd=tmp_path, env=os.environ, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(list(work.path("huge.tiles").glob("*.png"))) == 2 and not work.path("huge.png").exists()
    resumed = work.run(*command, "--resume")
    assert resumed.status == 0, resumed.err
    np.testing.assert_array_equal(pixels(work.path("huge.png")), pixels(work.path("whole.png")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--tiles", "4"), "--tiles is '4', expected columns and rows, such as 4x4, or auto"),
        (("--tiles", "0x2"), "--tiles 0x2: columns is 0, expected 1 to 5"),
        (("--tiles", "2x9"), "--tiles 2x9: rows is 9, expected 1 to 4"),
        (("--tiles", "2x2", "--format", "npz"), "--tiles needs .png or .exr"),
        (("--tiles", "2x2", "--aov", "depth"), "write the layers into an EXR: give -o NAME.exr"),
        (("--tiles", "2x2", "--aov", "deep", "--format", "exr"), "--aov deep and --tiles exclude each other"),
        (
            ("--tiles", "2x2", "--aov", "cryptomatte", "--format", "exr"),
            "--aov cryptomatte and --tiles exclude each other",
        ),
        (("--tiles", "2x2", "--pipeline", "realtime"), "needs the whole image"),
        (("--tiles", "2x2", "--pipeline", "path", "--set=noise=0.1"), "choose samples by the whole image"),
    ],
)
def test_render_refuses_options_that_cannot_be_combined_with_tiles(
    work, options: tuple[str, ...], message: str
) -> None:
    """Each refusal prints one line with status 2, and no image is written."""
    done = work.run("render", "@capture.ply", "-o", "@out", *SIZE, *options)
    assert done.status == 2 and message in done.err, done.err
    assert done.err.strip().count("\n") == 0
    assert not [name for name in work.files() if name.endswith((".png", ".exr"))]
