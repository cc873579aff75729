"""Tests ``--tiles samples``: workers share the samples of a frame, and killed workers lose no finished samples."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.io.images.exr import read_exr
from support.files.cli_files import Workspace

OPTIONS = ("--pipeline", "path", "--lighting", "on", "--width", "24", "--height", "16", "--device", "cpu")
TWO = ("--workers", "2")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


def assert_same(one: Path, other: Path) -> None:
    """Asserts that all channels of two EXRs are equal bit by bit."""
    channels, others = read_exr(one), read_exr(other)
    assert channels.keys() == others.keys()
    for name, image in channels.items():
        np.testing.assert_array_equal(image, others[name], name)


def test_image_merged_from_sample_blocks_equals_a_whole_render(work) -> None:
    """Only rounding differs, as sums are added in another order; the files of sample blocks are removed."""
    options = ("@capture.ply", *OPTIONS, "--samples", "70", "--aov", "albedo,depth")
    assert work.run("render", *options, "-o", "@plain.exr").status == 0
    assert work.run("render", *options, "-o", "@shared.exr", "--tiles", "samples", "--resume").status == 0
    assert not work.path("shared.samples").exists()
    plain, shared = read_exr(work.path("plain.exr")), read_exr(work.path("shared.exr"))
    np.testing.assert_array_equal(shared["depth.Z"], plain["depth.Z"])
    np.testing.assert_allclose(shared["R"], plain["R"], atol=1e-6)
    again = work.run("render", *options, "-o", "@shared.exr", "--tiles", "samples", "--resume")
    assert again.status == 0 and again.out.strip() == str(work.path("shared.exr"))


def test_tiles_merged_from_sample_blocks_equal_a_whole_render(work) -> None:
    """Tiles rendered in blocks of samples equal an image rendered in such blocks bit by bit.

    No intermediate file is left.
    """
    options = ("@capture.ply", *OPTIONS, "--samples", "40", "--aov", "albedo,depth")
    assert work.run("render", *options, "-o", "@alone.exr", "--tiles", "samples").status == 0
    done = work.run("render", *options, "-o", "@shared.exr", "--tiles", "2x1,samples")
    assert done.status == 0, done.err
    assert done.out.startswith(f"{work.path('shared.exr')}\n")
    assert_same(work.path("shared.exr"), work.path("alone.exr"))
    assert not [name for name in work.files() if ".tiles" in name or ".samples" in name]
    assert not work.path("shared.tiles").exists()


def test_sample_blocks_are_removed_once_their_tile_is_written(work, monkeypatch: pytest.MonkeyPatch) -> None:
    """After an interruption in the second tile, only the first tile exists, and the next run renders the rest."""
    options = ("@capture.ply", *OPTIONS, "--samples", "40", "-o", "@out.exr", "--tiles", "2x1,samples")
    made: list[range] = []
    render = ls.farm.render_samples

    def counted(renderer, scene, camera, samples, **options):
        made.append(samples)
        if len(made) == 4:
            raise KeyboardInterrupt
        return render(renderer, scene, camera, samples, **options)

    monkeypatch.setattr(ls.farm, "render_samples", counted)
    stopped = work.run("render", *options)
    assert stopped.status == 130 and "holds 4 of 6 parts; the same command with --resume continues" in stopped.err, (
        stopped.err
    )
    left = {name for name in work.files() if name.startswith("out.")}
    assert left == {"out.render.json", "out.tiles/0_0_16_16.exr", "out.tiles/16_0_8_16.samples/000000.npz"}
    assert work.run("render", *options, "--resume").status == 0
    assert made[4:] == [range(32, 40)]
    assert {name for name in work.files() if name.startswith("out.")} == {"out.render.json", "out.exr"}


@pytest.mark.deep
def test_render_by_sample_blocks_continues_after_a_killed_process(work, tmp_path: Path) -> None:
    """Finished blocks stay, and the image equals that of one process."""
    options = ["capture.ply", *OPTIONS, "--width", "96", "--height", "64", "--samples", "320"]
    assert work.run("render", "@capture.ply", *options[1:], "-o", "@alone.exr", "--tiles", "samples").status == 0
    command = [
        sys.executable,
        "-m",
        "lumisplat",
        "render",
        *options,
        "-o",
        "shared.exr",
        "--tiles",
        "samples",
        "--resume",
    ]
    killed = subprocess.Popen(command, cwd=tmp_path)
    wait_for(lambda: blocks(work) >= 4)
    killed.kill()
    killed.wait()
    finished = {path: path.stat().st_mtime_ns for path in work.path("shared.samples").glob("[!.]*.npz")}
    assert 4 <= len(finished) < 10 and not work.path("shared.exr").exists()
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0
    assert_same(work.path("shared.exr"), work.path("alone.exr"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--tiles", "2x2,samples", "--denoise"), "--denoise and --tiles exclude each other"),
        (("--tiles", "2x1,samples", "--pipeline", "raster", "--lighting", "off"), "drawn in one go"),
        (("--set=noise=0.1",), "to split a frame, set only samples"),
        (("--pipeline", "realtime"), "drawn in one go"),
        (("--pipeline", "raster", "--lighting", "off"), "drawn in one go"),
    ],
)
def test_render_refuses_options_that_cannot_be_combined_with_sample_blocks(
    work, options: tuple[str, ...], message: str
) -> None:
    """Each refusal prints one line with status 2, and no image is written."""
    done = work.run("render", "@capture.ply", "-o", "@out", *OPTIONS, "--tiles", "samples", *options)
    assert done.status == 2 and message in done.err, done.err
    assert done.err.strip().count("\n") == 0 and not list(work.folder.rglob("*.png"))


def blocks(work: Workspace) -> int:
    """Returns the existing blocks."""
    return len(list(work.path("shared.samples").glob("[!.]*.npz")))


def wait_for(condition) -> None:
    """Waits until a condition holds."""
    for _ in range(2400):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it never came")
