"""Tests closed, full and unread standard streams: no traceback, and images are still written."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

INFO, WRONG, HELP = "info mesh.obj", "info missing.ply", "--help"


@pytest.fixture
def shell(tmp_path: Path):
    """Runs a command line of lumisplat in bash, in a folder with a mesh."""
    (tmp_path / "mesh.obj").write_text("v -1 -1 4\nv 1 -1 4\nv 0 1 4\nf 1 2 3\n")

    def run(line: str) -> subprocess.CompletedProcess[str]:
        command = f'set -o pipefail; "{sys.executable}" -m lumisplat {line}'
        return subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False)

    return run


@pytest.mark.parametrize(
    ("command", "closed"),
    [*((INFO, closed) for closed in (">&-", "2>&-", "<&-", "<&- >&- 2>&-")), (HELP, ">&-"), (HELP, "2>&-")],
)
def test_commands_run_with_closed_standard_streams(shell, command: str, closed: str) -> None:
    """Only the output to closed streams is lost."""
    done = shell(f"{command} {closed}")
    assert (done.returncode, done.stderr) == (0, "")
    assert bool(done.stdout) == (">&-" not in closed.split())


@pytest.mark.parametrize("closed", [">&-", "2>&-"])
def test_closed_standard_streams_do_not_change_the_exit_status(shell, closed: str) -> None:
    """A mistake ends with status 2."""
    done = shell(f"{WRONG} {closed}")
    assert done.returncode == 2
    assert done.stderr == ("" if "2" in closed else "error: missing.ply: no such file\n")


@pytest.mark.parametrize("command", [INFO, HELP])
@pytest.mark.parametrize("pipe", ["| head -0", "2>&1 | head -0"])
def test_commands_end_silently_if_no_process_reads_their_output(shell, command: str, pipe: str) -> None:
    """The status is that of a broken pipe."""
    done = shell(f"{command} {pipe}")
    assert (done.returncode, done.stdout, done.stderr) == (141, "", "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("command", [INFO, HELP])
def test_full_disk_for_standard_output_is_reported_in_one_line(
    shell, monkeypatch, command: str, unbuffered: str
) -> None:
    """The command ends with status 2."""
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    done = shell(f"{command} > /dev/full")
    assert done.returncode == 2
    assert done.stderr.startswith("error: standard output: cannot be ")
    assert done.stderr.endswith("written: No space left on device\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no /dev/full")
def test_full_disk_for_standard_error_keeps_the_exit_status(shell) -> None:
    """The message is lost."""
    assert shell(f"{WRONG} 2> /dev/full").returncode == 2


def test_render_works_without_standard_error(shell, tmp_path: Path) -> None:
    """Loading kernels must not need the descriptor of standard error."""
    done = shell("render mesh.obj --width 32 --device cpu -o seen.png 2>&-")
    assert (done.returncode, done.stdout) == (0, "seen.png (32 x 18)\n")
    assert (tmp_path / "seen.png").stat().st_size > 0
