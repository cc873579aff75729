"""Tests ``lumisplat farm train``: captures equal those of one process, and mistakes are one line."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from lumisplat.cli import main
from support.scenes.training_scenes import write_training_folder

SHORT = ("--iterations", "20", "--cap", "100", "--sh-degree", "0", "--prune-below", "0", "--device", "cpu")


pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's


@pytest.fixture(autouse=True)
def _log_level(monkeypatch) -> None:
    """Restores Warp's log level after a test."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)


@pytest.mark.deep
def test_farm_trained_captures_equal_those_of_separate_trainings(
    ray: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two workers give equal bits and print the reports; the same command finds all captures."""
    folders = [str(write_training_folder(tmp_path / name)) for name in ("one", "two")]
    assert main(["train", folders[1], "-o", str(tmp_path / "two.ply"), *SHORT, "--seed", "5"]) == 0
    command = ["farm", "train", *folders, "-o", str(tmp_path / "captures"), *SHORT, "--seed", "5", "--workers", "2"]
    capsys.readouterr()
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "by 2 workers" in printed.out and printed.out.count("100 Gaussians, 20 of 20 steps") == 2, printed
    for name in ("one.ply", "one.txt", "two.txt", "train.json", "two.training/checkpoint.npz"):
        assert (tmp_path / "captures" / name).is_file()
    assert (tmp_path / "captures/two.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()
    assert main([*command, "--seed", "6"]) == 2
    assert "holds frames of other settings or files (seed" in capsys.readouterr().err


def test_farm_train_settings_file_sets_options_per_image_folder(ray: Any, tmp_path: Path, capsys, caplog) -> None:
    """Captures equal those of ``train`` with these options bit by bit.

    Folders may be added later, and a changed setting is named. Overwriting removes only the capture and its checkpoint.
    """
    one, two = (str(write_training_folder(tmp_path / name)) for name in ("one", "two"))
    own = tmp_path / "own.toml"
    own.write_text("[two]\ncap = 60\nantialiased = true\n")
    assert main(["train", two, "-o", str(tmp_path / "two.ply"), *SHORT, "--cap", "60", "--antialiased"]) == 0
    command = ["farm", "train", "-o", str(tmp_path / "out"), *SHORT, "--settings", str(own), "--workers", "1"]
    assert main([*command, one]) == 0
    assert "[two] belongs to no given folder: there are one" in caplog.text
    assert main([*command, one, two]) == 0
    assert (tmp_path / "out/two.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()
    printed = capsys.readouterr().out
    assert "100 Gaussians" in printed and "60 Gaussians" in printed and "1 of them already existed" in printed
    own.write_text("[two]\ncap = 70\nantialiased = true\n")
    assert main([*command, one, two]) == 2
    assert "holds frames of other settings or files (settings of two" in capsys.readouterr().err
    others = [tmp_path / "out/other.txt", tmp_path / "out/two.training/note.txt"]
    for path in others:
        path.write_text("mine")
    assert main([*command, two, "--overwrite"]) == 0
    assert "70 Gaussians, 20 of 20 steps" in capsys.readouterr().out
    assert [path.read_text() for path in others] == ["mine", "mine"]


def test_farm_train_continues_a_training_interrupted_by_the_stop_after_option(
    ray: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``--stop-after`` leaves an unfinished capture and reports it; the same command continues to equal bits."""
    folder, long = str(write_training_folder(tmp_path / "one")), ("--iterations", "200", *SHORT[2:])
    assert main(["train", folder, "-o", str(tmp_path / "alone.ply"), *long]) == 0
    command = ["farm", "train", folder, "-o", str(tmp_path / "out"), *long, "--workers", "1"]
    capsys.readouterr()
    assert main([*command, "--stop-after", "0.01s"]) == 0
    printed = capsys.readouterr().out
    assert (
        " of 200 steps" in printed and "200 of 200" not in printed and printed.endswith("the same command continues\n")
    )
    assert (tmp_path / "out/one.unfinished.txt").is_file() and not (tmp_path / "out/one.txt").exists()
    assert main(command) == 0
    assert "200 of 200 steps" in capsys.readouterr().out
    assert (tmp_path / "out/one.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
    assert not (tmp_path / "out/one.unfinished.txt").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[a]\ncup = 3\n", "own.toml: [a] unknown key 'cup', expected options of train"),
        ("[a]\noverwrite = true\n", "own.toml: [a] unknown key 'overwrite'"),
        ("[a]\ncap = 'x'\n", "own.toml: [a] --cap is 'x', expected a whole number"),
        ("[a]\ncap = [3]\n", "own.toml: [a] cap is [3], expected a number or a word"),
        ("[a]\nexposures = 1\n", "own.toml: [a] exposures is 1, expected true or false"),
        ("[a]\ncap = 0\n", "own.toml: [a] cap is 0"),
        ("cap = 3\n", "own.toml: cap is in no table: begin a table with the name of a folder, [a]"),
        ("[a\n", "own.toml: cannot be read as TOML"),
    ],
)
def test_farm_train_reports_mistakes_in_the_settings_file_in_one_line(
    tmp_path, monkeypatch, capsys, content: str, message: str
) -> None:
    """Each mistake ends with status 2, before any file is written."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "own.toml").write_text(content)
    assert main(["farm", "train", "a", "--settings", "own.toml", "--device", "cpu"]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.strip().count("\n") == 0 and printed.out == ""
    assert not (tmp_path / "captures").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("lost",), "lost: no such folder"),
        ((), "no images given: name one folder or more"),
        (("a/fox", "b/fox"), "a/fox and b/fox would both become fox.ply"),
        (("a", "--stop-after", "soon"), "--stop-after is 'soon', expected a time such as 90s, 10m or 1.5h"),
        (("a", "--relightable", "--exposures"), "leave out --exposures"),
        (("a", "--settings", "lost.toml"), "lost.toml: no such file"),
        (("a", "--workers", "0"), "--workers is 0, expected 1 or more"),
    ],
)
def test_farm_train_reports_mistakes_in_options_in_one_line(
    tmp_path, monkeypatch, capsys, options: tuple[str, ...], message: str
) -> None:
    """Each mistake ends with status 2."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    assert main(["farm", "train", *options, "--device", "cpu"]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.strip().count("\n") == 0 and printed.out == ""
    assert not (tmp_path / "captures").exists()


@pytest.mark.deep
def test_farm_train_continues_after_a_killed_worker(ray: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """After SIGKILL another worker continues from the checkpoint to equal bits."""
    folder, long = str(write_training_folder(tmp_path / "one")), ("--iterations", "600", *SHORT[2:])
    assert main(["train", folder, "-o", str(tmp_path / "alone.ply"), *long]) == 0

    def kill() -> None:
        while not (tmp_path / "out/one.training").exists():
            time.sleep(0.02)
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if b"ray::Worker.make" in (process / "cmdline").read_bytes():
                    if (process / "cwd").resolve() == Path.cwd():
                        os.kill(int(process.name), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    assert main(["farm", "train", folder, "-o", str(tmp_path / "out"), *long, "--workers", "1"]) == 0
    killer.join()
    assert "a worker was lost (" in caplog.text
    assert (tmp_path / "out/one.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()
