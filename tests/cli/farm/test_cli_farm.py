"""``lumisplat farm``: the same frames as one process makes, to the bit; mistakes in one line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import warp as wp

import lumisplat as ls
from lumisplat.cli import main
from support.files.cli_files import Workplace
from support.scenes.raster_scenes import random_gaussians

SIZE = ("--width", "24", "--height", "16", "--device", "cpu")
TWO = ("--workers", "2")
SCENE = """
[[splats]]
path = "capture.ply"

[[lights]]
type = "point"
position = [0.6, 2.0, 0.4]
intensity = 4.0

[[actors]]
path = "ball.ply"

[[actors.keyframes]]
time = 0.0
position = [-0.5, 0.0, 4.0]

[[actors.keyframes]]
time = 0.4
position = [0.5, 0.0, 4.0]

[animation]
fps = 10.0
frames = 5

[animation.lighting.shadow_map]
resolution = 32
bins = 16
"""


@pytest.fixture
def work(tmp_path, capsys, monkeypatch) -> Workplace:
    """A folder to run commands in; what they do to Warp's log level is undone."""
    monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)
    place = Workplace(tmp_path, capsys)
    ls.save(place.path("ball.ply"), random_gaussians(2, count=20))
    place.path("scene.toml").write_text(SCENE)
    return place


def files(work: Workplace, folder: str) -> dict[str, bytes]:
    """All files of a folder, but for what is being written."""
    return {path.name: path.read_bytes() for path in sorted(work.path(folder).glob("[!.]*"))}


def test_an_animation_is_the_same(work) -> None:
    """Frames and manifest; either command goes on with the other's."""
    assert work.run("animate", "@scene.toml", "-o", "@whole", *SIZE).status == 0
    done = work.run(
        "farm", "animate", "@scene.toml", "-o", "@farm", *SIZE, *TWO, "--frames", "1-4", "--video", "@a.gif"
    )
    assert done.status == 0, done.err
    assert (
        "4 frames by 2 workers in " in done.out and "s of a worker each" in done.out and "a.gif (10 frames" in done.out
    )
    assert "5 frames in" in work.run("animate", "@scene.toml", "-o", "@farm", *SIZE).out
    assert files(work, "farm") == files(work, "whole")


@pytest.mark.deep
def test_orbits_and_pictures_are_the_same(work) -> None:
    """Random light, too: its numbers follow from the pixel and the sample."""
    paths = ("--pipeline", "path", "--samples", "3", "--lighting", "on")
    for options in (("--seconds", "0.2", "--fps", "20"), ("--seconds", "0.2", "--fps", "20", *paths, "--overwrite")):
        assert work.run("orbit", "@capture.ply", "-o", "@whole", *SIZE, *options).status == 0
        assert work.run("farm", "orbit", "@capture.ply", "-o", "@farm", *SIZE, *options, *TWO).status == 0
        assert files(work, "farm") == files(work, "whole")
    cameras = ("--cameras", str(work.path("cameras.json")), "--aov", "depth")
    assert work.run("render", "@capture.ply", "-o", "@pictures", *SIZE, *cameras, "--resume").status == 0
    assert work.run("farm", "render", "@capture.ply", "-o", "@farmed", *SIZE, *cameras, *TWO).status == 0
    assert files(work, "farmed") == files(work, "pictures")
    again = work.run("farm", "render", "@capture.ply", "-o", "@farmed", *SIZE, *cameras, *TWO)
    assert "2 frames in" in again.out and "2 of them were there" in again.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("orbit", "@capture.ply", "--workers", "0"), "--workers is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--cores", "0"), "--cores is 0, expected 1 or more"),
        (("orbit", "@capture.ply", "--stats"), "--stats is of one process"),
        (("orbit", "@capture.ply", "-o", "-"), "frames are many: give a folder"),
        (("orbit", "@lost.ply"), "lost.ply: no such file"),
        (("orbit", "@capture.ply", "--samples", "0"), "samples is 0, expected"),
        (("render", "@capture.ply", "--view", "normal"), "--view colours all pictures by the first"),
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
    """Where an address needs it; processes of this machine do not."""
    monkeypatch.setitem(sys.modules, "ray", None)
    for address in ("auto", "ray", "ray://farm:10001"):
        done = work.run("farm", "orbit", "@capture.ply", "-o", "@out", *SIZE, "--address", address)
        assert done.status == 2 and "pip install 'lumisplat[farm]'" in done.err


def test_help_teaches(capsys) -> None:
    """What it is, an example, the statuses."""
    assert main(["farm", "--help"]) == 0
    out = capsys.readouterr().out
    for words in ("animate", "orbit", "render", "Exit status", "--workers 2", "the same command continues"):
        assert words in out
    assert main(["farm", "animate", "--help"]) == 0
    assert "--address" in capsys.readouterr().out


@pytest.mark.deep
def test_sixty_frames_whatever_dies(work, tmp_path: Path) -> None:
    """A worker is killed, the driver is killed, and resumed: all frames are there, as of one process, to the bit."""
    work.path("scene.toml").write_text(SCENE.replace("frames = 5", "frames = 60"))
    size = ("--width", "320", "--height", "240", "--device", "cpu")
    assert work.run("animate", "@scene.toml", "-o", "@whole", *size).status == 0
    command = [sys.executable, "-m", "lumisplat", "farm", "animate", "scene.toml", "-o", "farm", *size, *TWO]
    driver = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: count(work) >= 8)
    worker = next(iter(workers_of(driver.pid)))
    os.kill(worker, signal.SIGKILL)
    wait_for(lambda: count(work) >= 20)
    driver.kill()
    assert "a worker was lost (killed by SIGKILL" in driver.communicate()[1]
    there = {path.name: path.stat().st_mtime_ns for path in work.path("farm").glob("*.png")}
    assert 20 <= len(there) < 60
    resumed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert resumed.returncode == 0, resumed.stderr
    assert files(work, "farm") == files(work, "whole")
    assert all((work.path("farm") / name).stat().st_mtime_ns == at for name, at in there.items())


def count(work: Workplace) -> int:
    """Frames of the farm that are there."""
    return len(list(work.path("farm").glob("*.png")))


def workers_of(driver: int) -> list[int]:
    """The processes that make frames for a driver."""
    workers: list[int] = []
    for child in Path(f"/proc/{driver}/task/{driver}/children").read_text().split():
        with suppress(OSError):  # it has just ended
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                workers.append(int(child))
    return workers


def wait_for(condition) -> None:
    """Waits until something is so."""
    for _ in range(2400):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it never came")
