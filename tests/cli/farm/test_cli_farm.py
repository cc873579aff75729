"""Tests ``lumisplat farm`` before workers start: its help, and mistakes in one line."""

from __future__ import annotations

import sys

import pytest
import warp as wp

from lumisplat.cli import main
from support.files.cli_files import Workspace

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")
TWO = ("--workers", "2")


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workspace:
    """Returns a folder to run commands in; Warp's log level is restored afterwards."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    return Workspace(tmp_path, capsys)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("orbit", "@capture.ply", "--workers", "0"), "--workers is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--cores", "0"), "--cores is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--stats"), "--stats needs one process"),
        (("orbit", "@capture.ply", "-o", "-"), "there are several frames: give a folder"),
        (("dance",), "'dance' is no command (see lumisplat farm --help)"),
    ],
)
def test_farm_reports_mistakes_in_options_before_workers_start(
    work, monkeypatch, options: tuple[str, ...], message: str
) -> None:
    """Each mistake prints one line with status 2, and no frame is written."""
    monkeypatch.chdir(work.folder)
    done = work.run("farm", *options, *(("--device", "cpu") if len(options) > 1 else ()))
    assert (done.status, done.out) == (2, ""), done.err
    assert message in done.err and done.err.strip().count("\n") == 0
    assert not [name for name in work.files() if name.endswith(".png")]


def test_farm_without_ray_names_the_package_extra_to_install(work, monkeypatch) -> None:
    """The error also names the commands that divide frames without Ray, by ``--frames``."""
    monkeypatch.setitem(sys.modules, "ray", None)
    for address in ("local", "auto", "ray://farm:10001"):
        done = work.run("farm", "orbit", "@capture.ply", "-o", "@out", *SIZE, "--address", address)
        assert done.status == 2 and "pip install 'lumisplat[farm]'" in done.err
        assert "divide frames of orbit, animate or render --resume by --frames" in done.err
    for command in ("orbit", "render --resume --cameras @cameras.json"):
        for frame in "01":
            line = f"{command} @capture.ply -o @{command[:5]} --frames {frame}"
            assert work.run(*line.split(), *SIZE).status == 0
        assert len(list(work.path(command[:5]).glob("*.png"))) == 2


def test_command_without_farm_has_the_statistics_that_farm_refuses(work) -> None:
    """Only one process can measure its stages."""
    line = ("orbit", "@capture.ply", "-o", "@out", "--frames", "0", "--stats", *SIZE)
    assert "run the command without farm" in work.run("farm", *line).err
    assert work.run(*line).status == 0


def test_farm_help_has_an_example_and_the_exit_statuses(capsys) -> None:
    """The help also names the commands and how to continue."""
    assert main(["farm", "--help"]) == 0
    out = capsys.readouterr().out
    for words in ("animate", "orbit", "render", "Exit status", "--workers 2", "The same command continues"):
        assert words in out
    assert main(["farm", "animate", "--help"]) == 0
    assert "--address" in capsys.readouterr().out
