"""Tests ``lumisplat view``: the printed address, refused requests and files, and interruption."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import lumisplat as ls
from support.files.cli_files import Workspace
from support.scenes.raster_scenes import random_gaussians

pytest.importorskip("viser", reason="the extra view is not installed")

PATIENCE_S = 300.0
"""Seconds after which a wait fails, long enough for a busy machine."""


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Returns the path of a small capture."""
    ls.save(tmp_path / "ball.ply", random_gaussians(1, count=50))
    return tmp_path / "ball.ply"


@contextmanager
def serving(*args: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Runs ``view`` in a child process, and yields the process and the address that it has printed."""
    command = [sys.executable, "-m", "lumisplat", "view", *args, "--port", "0", "--no-browser", "--device", "cpu"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def status(address: str) -> int:
    """Returns the HTTP status of a request."""
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE_S) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        with error:
            return error.code


def test_view_command_prints_its_address_and_serves_until_interrupted(capture: Path) -> None:
    """Standard output has one line with the address; without its token the page is refused."""
    with serving(str(capture)) as (process, address):
        assert address.startswith("http://127.0.0.1:") and "/?token=" in address
        assert status(address) == 200 and status(address.partition("?")[0]) == 401
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=PATIENCE_S)
        assert not rest and "Traceback" not in errors and process.returncode in (0, 130)


def test_view_command_leaves_out_files_that_cannot_be_read(capture: Path) -> None:
    """The page is served with the other files, and standard error names the unreadable one."""
    with serving(str(capture), str(capture.with_name("gone.obj"))) as (process, address):
        assert status(address) == 200
        process.send_signal(signal.SIGINT)
        assert "gone.obj" in process.communicate(timeout=PATIENCE_S)[1]


def test_view_command_admits_other_machines_only_with_the_host_option(capture: Path) -> None:
    """Standard error warns of open access, and the token is still needed."""
    with serving(str(capture), "--host", "0.0.0.0") as (process, address):
        assert status(address) == 200 and status(address.partition("?")[0]) == 401
        process.send_signal(signal.SIGINT)
        assert "open to all machines that reach 0.0.0.0" in process.communicate(timeout=PATIENCE_S)[1]


def test_view_command_reports_mistakes_of_the_user_in_one_line(
    tmp_path: Path, capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Mistakes are no scene, a missing file, a port in use, and two scene files."""
    work = Workspace(tmp_path, capsys)
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).write_text("")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for args, words in (
            ((), "no scene given"),
            (("@gone.ply", "--port", "0"), "gone.ply"),
            ((str(capture), "--port", port), f"port {port} of 127.0.0.1"),
            ((str(capture), "--height", "60"), "height is 60, expected 90 to 2160"),
            ((str(capture), "--budget", "nan"), "budget is nan"),
            (("@a.toml", "@b.toml", "--port", "0"), "both scene files"),
        ):
            outcome = work.run("view", *args, "--no-browser", "--device", "cpu")
            assert outcome.status == 2 and words in outcome.err and outcome.err.count("\n") == 1, outcome
