"""``lumisplat farm train``: several captures, the same as those of one process; mistakes in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import warp as wp

from lumisplat.cli import main
from support.scenes.training_scenes import folder_of

SHORT = ("--iterations", "20", "--cap", "100", "--sh-degree", "0", "--prune-below", "0", "--device", "cpu")


@pytest.fixture(autouse=True)
def _log_level(monkeypatch) -> None:
    """What commands do to Warp's log level is undone."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)


def test_captures_are_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By two workers, to the bit; what came of each is printed; the same command finds all there."""
    folders = [str(folder_of(tmp_path / name)) for name in ("one", "two")]
    assert main(["train", folders[1], "-o", str(tmp_path / "two.ply"), *SHORT, "--seed", "5"]) == 0
    command = ["farm", "train", *folders, "-o", str(tmp_path / "captures"), *SHORT, "--seed", "5", "--workers", "2"]
    capsys.readouterr()
    assert main(command) == 0
    told = capsys.readouterr()
    assert "by 2 workers" in told.out and told.out.count("100 Gaussians, 20 of 20 steps") == 2, told
    for name in ("one.ply", "one.txt", "two.txt", "train.json", "two.training/checkpoint.npz"):
        assert (tmp_path / "captures" / name).is_file()
    assert (tmp_path / "captures/two.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()
    assert main([*command, "--seed", "6"]) == 2
    assert "holds frames from before a change of seed" in capsys.readouterr().err


@pytest.mark.deep
def test_a_killed_worker_loses_no_training(tmp_path: Path) -> None:
    """SIGKILL in the middle: another worker goes on from the checkpoint, to the same bits."""
    folder, long = str(folder_of(tmp_path / "one")), ("--iterations", "600", *SHORT[2:])
    assert main(["train", folder, "-o", str(tmp_path / "alone.ply"), *long]) == 0
    command = [sys.executable, "-m", "lumisplat", "farm", "train", folder, "-o", str(tmp_path / "out"), *long]
    farm = subprocess.Popen([*command, "--workers", "1"], stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "out/one.training").exists():
        time.sleep(0.05)
    children = Path(f"/proc/{farm.pid}/task/{farm.pid}/children").read_text().split()
    workers = [int(pid) for pid in children if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    for pid in workers:
        os.kill(pid, signal.SIGKILL)
    _, told = farm.communicate(timeout=600)
    assert farm.returncode == 0 and "a worker was lost (killed by SIGKILL" in told, told
    assert (tmp_path / "out/one.ply").read_bytes() == (tmp_path / "alone.ply").read_bytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("lost",), "lost: no such folder"),
        ((), "no photographs given: name one folder or more"),
        (("a/fox", "b/fox"), "a/fox and b/fox would both become fox.ply"),
        (("a", "--overwrite"), "--overwrite is of one training: give it to the command without farm"),
        (("a", "--stop-after", "3s"), "--stop-after is of one training"),
        (("a", "--workers", "0"), "--workers is 0, expected 1 or more"),
    ],
)
def test_mistakes(tmp_path, monkeypatch, capsys, options: tuple[str, ...], message: str) -> None:
    """One line and status 2."""
    monkeypatch.chdir(tmp_path)
    assert main(["farm", "train", *options, "--device", "cpu"]) == 2
    told = capsys.readouterr()
    assert message in told.err and told.err.strip().count("\n") == 0 and told.out == ""
    assert not (tmp_path / "captures").exists()
