"""Tests ``lumisplat extract-frames`` from the shell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main


def test_extract_frames_writes_images_and_prints_the_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The printed train command names the folder, and for images of 640 pixels and more a scale."""
    video, folder = tmp_path / "walk.mp4", tmp_path / "walk"
    ls.save_animation(video, np.random.default_rng(0).uniform(size=(6, 360, 480, 3)), fps=4)
    assert main(["extract-frames", str(video), "-o", str(folder)]) == 0
    assert len(list((folder / "images").glob("*.jpg"))) == 3
    printed = capsys.readouterr().out
    assert printed.startswith(f"{folder / 'images'}: 3 images of 480 x 360\n")
    assert f"next: lumisplat train {folder} -o walk.ply --poses colmap-film --stop-after 5m" in printed
    ls.save_animation(video, np.random.default_rng(0).uniform(size=(4, 640, 400, 3)), fps=4)
    assert main(["extract-frames", str(video), "-o", str(tmp_path / "tall")]) == 0
    assert "--poses colmap-film --scale 0.5 --stop-after 5m" in capsys.readouterr().out


def test_extract_frames_reports_a_single_image_as_too_few(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In place of a train command, which would fail, the command prints what to change."""
    video = tmp_path / "walk.mp4"
    ls.save_animation(video, np.random.default_rng(0).uniform(size=(2, 48, 64, 3)), fps=4)
    assert main(["extract-frames", str(video), "-o", str(tmp_path / "walk")]) == 0
    printed = capsys.readouterr().out
    assert "1 image of 64 x 48\ntraining needs more than one image: give less than --every 0.5" in printed
    assert "next:" not in printed


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("none.mp4", "-o", "out"), "error: none.mp4: no such file"),
        (("text.mp4", "-o", "out"), "error: text.mp4: is not a readable video"),
        (("text.mp4", "-o", "there"), "error: there/images: already exists"),
        (("text.mp4", "-o", "out", "--every", "0"), "--every is 0"),
        (("text.mp4", "-o", "out", "--size", "1"), "--size is 1"),
    ],
)
def test_extract_frames_command_reports_mistakes_of_the_user_in_one_line(
    options: tuple[str, ...],
    problem: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The line names the file or the option."""
    monkeypatch.chdir(tmp_path)
    Path("text.mp4").write_text("no film")
    Path("there/images").mkdir(parents=True)
    assert main(["extract-frames", *options]) == 2
    printed = capsys.readouterr().err
    assert problem in printed and len(printed.strip().splitlines()) == 1


def test_error_for_the_former_frames_command_gives_the_extract_frames_command_to_type(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The line is the whole command as it is typed today."""
    assert main(["frames", "my walk.mp4", "-o", "walk"]) == 2
    problem = "error: frames is now extract-frames: lumisplat extract-frames 'my walk.mp4' -o walk\n"
    assert capsys.readouterr().err == problem
