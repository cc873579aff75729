"""Tests ``-o -``: the file goes to standard output, whole or not at all, and messages to standard error."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from lumisplat.cli import main
from support.files.splat_files import capture


@pytest.fixture
def run(tmp_path: Path):
    """Runs a command in a folder with a mesh and a capture; its streams are bytes."""
    (tmp_path / "mesh.obj").write_text("v -1 -1 4\nv 1 -1 4\nv 0 1 4\nf 1 2 3\n")
    ls.save(tmp_path / "capture.ply", capture(5))

    def of(*args: str) -> subprocess.CompletedProcess[bytes]:
        command = [sys.executable, "-m", "lumisplat", *args]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, check=False)

    return of


def test_render_writes_an_image_to_standard_output(run, tmp_path: Path) -> None:
    """The PNG equals that in a file; messages go to standard error, and no file is left."""
    piped = run("render", "mesh.obj", "--width", "32", "--device", "cpu", "-o", "-", "--stats")
    assert piped.returncode == 0
    assert b"\nlast frame" in b"\n" + piped.stderr
    assert piped.stderr.endswith(b"standard output (32 x 18)\n")
    assert {path.name for path in tmp_path.iterdir()} == {"mesh.obj", "capture.ply"}
    assert (
        main(["render", str(tmp_path / "mesh.obj"), "--width", "32", "--device", "cpu", "-o", f"{tmp_path}/file.png"])
        == 0
    )
    pixels = [np.asarray(Image.open(source)) for source in (io.BytesIO(piped.stdout), tmp_path / "file.png")]
    np.testing.assert_array_equal(pixels[0], pixels[1])


def test_convert_writes_a_ply_to_standard_output(run, tmp_path: Path) -> None:
    """The summary goes to standard error."""
    piped = run("convert", "capture.ply", "-")
    assert piped.returncode == 0
    assert piped.stderr.startswith(b"standard output: 5 Gaussians")
    (tmp_path / "piped.ply").write_bytes(piped.stdout)
    again = ls.load(tmp_path / "piped.ply")
    assert isinstance(again, ls.Gaussians)
    assert again.count == 5


def test_render_that_fails_writes_nothing_to_standard_output(run) -> None:
    """Each mistake prints one line on standard error."""
    for args, named in ((("missing.ply",), b"missing.ply"), (("mesh.obj", "--aov", "depth"), b"-o - is one file")):
        done = run("render", *args, "-o", "-")
        assert (done.returncode, done.stdout) == (2, b"")
        assert named in done.stderr
        assert done.stderr.count(b"\n") == 1


def test_info_prints_repeated_mesh_instances_once(tmp_path: Path, capsys) -> None:
    """500 instances of a mesh have one table."""
    (tmp_path / "mesh.obj").write_text("v -1 -1 4\nv 1 -1 4\nv 0 1 4\nf 1 2 3\n")
    entry = '[[meshes]]\npath = "mesh.obj"\nposition = [{}, 0, 0]\n'
    (tmp_path / "many.toml").write_text("".join(entry.format(k) for k in range(500)))
    assert main(["info", str(tmp_path / "many.toml")]) == 0
    shown = capsys.readouterr().out
    assert "500 meshes" in shown
    assert "mesh 0   (500 times)" in " ".join(shown.split("\n")).replace("mesh 0      (", "mesh 0   (")
    assert shown.count("vertices") == 1
    assert "(-1, -1, 4) to (500, 1, 4)" in shown


@pytest.mark.parametrize(
    "command",
    [
        ("relight", "capture.ply", "mesh.obj", "--background", "white"),
        ("shadowmap", "mesh.obj", "--onto", "capture.ply", "--light", "0,-5,0", "--resolution", "64"),
    ],
    ids=["relight", "shadowmap"],
)
def test_relight_and_shadowmap_write_captures_to_standard_output(
    run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    """The PLY equals that in a file; messages go to standard error, and no file is left."""
    piped = run(*command, "--device", "cpu", "-o", "-")
    assert piped.returncode == 0, piped.stderr
    assert b"standard output: " in piped.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"mesh.obj", "capture.ply"}
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--device", "cpu", "-o", "file.ply"]) == 0
    assert piped.stdout == (tmp_path / "file.ply").read_bytes()


@pytest.mark.parametrize("command", [("orbit", "capture.ply"), ("animate", "scene.toml")])
def test_several_frames_on_standard_output_are_refused(run, command: tuple[str, ...]) -> None:
    """Commands that write several files print one line."""
    done = run(*command, "-o", "-")
    assert (done.returncode, done.stdout, done.stderr.count(b"\n")) == (2, b"", 1)
    assert b"-o - is one file, but there are several frames: give a folder" in done.stderr
