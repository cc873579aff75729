"""``lumisplat farm`` before it has workers: its help, and mistakes in one line."""

from __future__ import annotations

import sys

import pytest
import warp as wp

from lumisplat.cli import main
from support.files.cli_files import Workplace

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")
TWO = ("--workers", "2")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workplace:
    """A folder to run commands in; what they do to Warp's log level is undone."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workplace(tmp_path, capsys)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("orbit", "@capture.ply", "--workers", "0"), "--workers is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--cores", "0"), "--cores is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--stats"), "--stats is of one process"),
        (("orbit", "@capture.ply", "-o", "-"), "frames are many: give a folder"),
        (("dance",), "'dance' is no command (see lumisplat farm --help)"),
    ],
)
def test_mistakes(work, monkeypatch, options: tuple[str, ...], message: str) -> None:
    """One line and status 2, wherever they are found; no frame is there."""
    monkeypatch.chdir(work.folder)
    done = work.run("farm", *options, *(("--device", "cpu") if len(options) > 1 else ()))
    assert (done.status, done.out) == (2, ""), done.err
    assert message in done.err and done.err.strip().count("\n") == 0
    assert not [name for name in work.files() if name.endswith(".png")]


def test_without_ray_its_extra_is_named(work, monkeypatch) -> None:
    """And what serves without it."""
    monkeypatch.setitem(sys.modules, "ray", None)
    for address in ("local", "auto", "ray://farm:10001"):
        done = work.run("farm", "orbit", "@capture.ply", "-o", "@out", *SIZE, "--address", address)
        assert done.status == 2 and "pip install 'lumisplat[farm]'" in done.err and "--frames" in done.err


def test_help_teaches(capsys) -> None:
    """What it is, an example, the statuses."""
    assert main(["farm", "--help"]) == 0
    out = capsys.readouterr().out
    for words in ("animate", "orbit", "render", "Exit status", "--workers 2", "The same command continues"):
        assert words in out
    assert main(["farm", "animate", "--help"]) == 0
    assert "--address" in capsys.readouterr().out
