"""``lumisplat frames`` from the shell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main


def test_a_film_becomes_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It says how many, and what to do with them."""
    film, folder = tmp_path / "walk.mp4", tmp_path / "walk"
    ls.save_animation(film, np.random.default_rng(0).uniform(size=(6, 48, 64, 3)), fps=4)
    assert main(["frames", str(film), "-o", str(folder)]) == 0
    assert len(list((folder / "images").glob("*.jpg"))) == 3
    told = capsys.readouterr().out
    assert told.startswith(f"{folder / 'images'}: 3 photographs of 64 x 48\n")
    assert f"next: lumisplat train {folder} -o walk.ply --poses colmap-film --stop-after 5m" in told
    ls.save_animation(film, np.random.default_rng(0).uniform(size=(4, 640, 400, 3)), fps=4)
    assert main(["frames", str(film), "-o", str(tmp_path / "tall")]) == 0
    assert "--poses colmap-film --scale 0.5 --stop-after 5m" in capsys.readouterr().out


def test_one_photograph_is_too_few(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Then the next command would fail: what is to be done is said in its place."""
    film = tmp_path / "walk.mp4"
    ls.save_animation(film, np.random.default_rng(0).uniform(size=(2, 48, 64, 3)), fps=4)
    assert main(["frames", str(film), "-o", str(tmp_path / "walk")]) == 0
    told = capsys.readouterr().out
    assert "1 photograph of 64 x 48\none is too few for a capture: give less than --every 0.5" in told
    assert "next:" not in told


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("none.mp4", "-o", "out"), "error: none.mp4: no such file"),
        (("text.mp4", "-o", "out"), "error: text.mp4: is no film that can be read"),
        (("text.mp4", "-o", "there"), "error: there/images: is there already"),
        (("text.mp4", "-o", "out", "--every", "0"), "--every is 0"),
        (("text.mp4", "-o", "out", "--size", "1"), "--size is 1"),
    ],
)
def test_mistakes_are_said_in_one_line(
    options: tuple[str, ...],
    problem: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """In the words of the shell."""
    monkeypatch.chdir(tmp_path)
    Path("text.mp4").write_text("no film")
    Path("there/images").mkdir(parents=True)
    assert main(["frames", *options]) == 2
    told = capsys.readouterr().err
    assert problem in told and len(told.strip().splitlines()) == 1
