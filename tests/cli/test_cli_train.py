"""Tests ``lumisplat train``."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.cli.input.numbers import seconds_of
from support.scenes.training_scenes import write_training_folder

SHORT = ("--iterations", "30", "--cap", "120", "--sh-degree", "1", "--prune-below", "0", "--device", "cpu")


def test_interrupted_training_continues_with_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The output has scores and the file; a finished training has nothing left to do."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "out" / "a.ply"
    assert main(["train", str(folder), "-o", str(output), *SHORT, "--stop-after", "0.01s"]) == 0
    assert main(["train", str(folder), "-o", str(output), *SHORT, "--stop-after", "0.01s", "--overwrite"]) == 0
    assert "the same command without --overwrite continues" in capsys.readouterr().out
    assert main(["train", str(folder), "-o", str(output), *SHORT, "--stop-after", "0.01s"]) == 0
    assert "of 30 steps" in (first := capsys.readouterr().out) and "the same command continues" in first
    assert main(["train", str(folder), "-o", str(output), *SHORT]) == 0
    printed = capsys.readouterr().out
    assert "held out" in printed and "120 Gaussians, 30 of 30 steps" in printed and "continues" not in printed
    stored = output.read_bytes()
    assert main(["train", str(folder), "-o", str(output), *SHORT]) == 0 and output.read_bytes() == stored
    asset = ls.load(output)
    assert isinstance(asset, ls.Gaussians) and asset.count == 120


def test_train_by_ray_tracing_stores_the_kernel_degree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Evaluation of the file also uses rays."""
    folder, output = write_training_folder(tmp_path / "set"), tmp_path / "a.ply"
    rays = ("--pipeline", "trace", "--kernel-degree", "4", "--iterations", "3", "--cap", "60", "--sh-degree", "1")
    assert main(["train", str(folder), "-o", str(output), *rays, "--device", "cpu"]) == 0
    asset = ls.load(output)
    assert isinstance(asset, ls.Gaussians) and asset.kernel_degree == 4
    printed = capsys.readouterr().out.split()
    measured = printed[printed.index("mean") + 1]
    assert main(["evaluate", str(output), str(folder), "--pipeline", "trace", "--device", "cpu"]) == 0
    again = capsys.readouterr().out.split()
    assert float(again[again.index("views") + 1]) == pytest.approx(float(measured), abs=0.011)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("-o", "a.ply", "--kernel-degree", "4"), "--kernel-degree is 4, which needs rays: use --pipeline trace"),
        (("-o", "a.spz", "--pipeline", "trace", "--kernel-degree", "4"), "a.spz, but .spz cannot store kernel degree"),
        (("-o", "a.obj"), "-o is a.obj, expected a file that ends in .ply or .spz"),
        (("-o", "a.ply", "--stop-after", "soon"), "--stop-after is 'soon', expected a time such as 90s, 10m or 1.5h"),
        (("-o", "a.ply", "--cap", "0"), "cap is 0, expected"),
        (("-o", "a.ply", "--preview", "0"), "preview is 0, expected"),
        (
            ("-o", "a.ply", "--background", "mauvish"),
            "--background is 'mauvish', expected three numbers in 0..1, '#ff8800', a name such as 'white', or "
            "'transparent', or random: another one in each step",
        ),
    ],
)
def test_train_command_reports_mistakes_of_the_user_in_one_line(
    options: tuple[str, ...],
    problem: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Messages name options, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    folder = write_training_folder(tmp_path / "set", 3)
    before = sorted(tmp_path.rglob("*"))
    assert main(["train", str(folder), "--device", "cpu", *options]) == 2
    printed = capsys.readouterr().err
    assert problem in printed and printed.strip().count("\n") == 0
    assert sorted(tmp_path.rglob("*")) == before


def test_train_refuses_a_folder_without_poses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The message lists what the folder should have."""
    assert main(["train", str(tmp_path), "-o", str(tmp_path / "a.ply"), "--device", "cpu"]) == 2
    assert "transforms.json" in capsys.readouterr().err


def test_train_that_needs_colmap_poses_without_pycolmap_names_the_extra_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message has the pip command."""
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    folder = write_training_folder(tmp_path / "set", 3)
    (folder / "transforms.json").unlink()
    assert main(["train", str(folder), "-o", str(tmp_path / "a.ply"), "--poses", "colmap", "--device", "cpu"]) == 2
    assert "lumisplat[poses]" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "seconds"), [("90", 90.0), ("90s", 90.0), ("10m", 600.0), ("1.5 h", 5400.0)])
def test_stop_after_option_of_train_accepts_seconds_minutes_and_hours(text: str, seconds: float) -> None:
    """A number without unit is in seconds."""
    assert seconds_of("--stop-after", text) == seconds
