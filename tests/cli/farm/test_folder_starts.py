"""Tests simultaneous runs in an empty folder: equal settings share it, of different settings only one run starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import lumisplat as ls
from lumisplat.cli.output.frame_folder import FrameFolder
from support.frame_makers import FakeMaker


def at_once(tasks: list[Callable[[], None]]) -> list[Exception]:
    """Runs tasks simultaneously, and returns their errors."""
    errors: list[Exception] = []
    barrier = threading.Barrier(len(tasks))

    def run(task: Callable[[], None]) -> None:
        barrier.wait()
        try:
            task()
        except ls.ConfigError as error:
            errors.append(error)

    threads = [threading.Thread(target=run, args=(task,)) for task in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return errors


def starts(folder: FrameFolder, seeds: list[int], *, overwrite: bool = False) -> list[Callable[[], None]]:
    """Returns functions that each start a run with one of the seeds."""
    return [lambda seed=seed: folder.prepare({"seed": f"{seed}"}, overwrite) for seed in seeds]


def test_only_one_of_several_runs_with_different_settings_gets_a_frame_folder(tmp_path: Path) -> None:
    """Seven of eight simultaneous runs are refused with a line that names the differences.

    The stored settings are whole.
    """
    for number in range(20):
        folder = FrameFolder(tmp_path / f"{number}", "png")
        errors = at_once(starts(folder, list(range(8))))
        assert len(errors) == 7
        assert all("another run has begun there, which differs in seed: " in str(error) for error in errors)
        stamp = json.loads((folder.folder / "animate.json").read_text())
        folder.check_current(stamp)
        assert [path.name for path in folder.folder.iterdir()] == ["animate.json"]


def test_simultaneous_runs_with_equal_settings_share_a_frame_folder(tmp_path: Path) -> None:
    """Tasks of a job array start simultaneously in one folder."""
    for number in range(20):
        folder = FrameFolder(tmp_path / f"{number}", "png")
        assert at_once(starts(folder, [3] * 8)) == []
        folder.check_current({"seed": "3"})


def test_only_one_of_several_overwriting_runs_keeps_the_frame_folder(tmp_path: Path) -> None:
    """The other runs stop at their next frame, because another run uses the folder."""
    for number in range(20):
        folder = FrameFolder(tmp_path / f"{number}", "png")
        folder.prepare({"seed": "0"}, False)
        (folder.folder / "frame_0000.png").write_text("old")
        assert at_once(starts(folder, list(range(1, 9)), overwrite=True)) == []
        current = 0
        for seed in range(9):
            try:
                folder.check_current({"seed": f"{seed}"})
                current += 1
            except ls.ConfigError:
                pass
        assert current == 1 and not (folder.folder / "frame_0000.png").exists()


def test_frame_folder_of_a_run_without_frames_yet_is_not_overwritten(tmp_path: Path) -> None:
    """The first frame of the other run may take hours; the message offers --overwrite if that run has ended."""
    folder = FrameFolder(tmp_path, "png")
    folder.prepare({"seed": "1", "samples": "8"}, False)
    with pytest.raises(ls.ConfigError) as raised:
        folder.prepare({"seed": "2", "samples": "8"}, False)
    assert str(raised.value) == (
        f"{tmp_path}: another run has begun there, which differs in seed: choose another folder, or give --overwrite "
        "if it has ended without a frame"
    )
    folder.check_current({"seed": "1", "samples": "8"})
    folder.prepare({"seed": "2", "samples": "8"}, True)
    folder.check_current({"seed": "2", "samples": "8"})


def test_last_started_run_owns_the_frame_folder_on_file_systems_without_hard_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some file systems have no hard links."""
    monkeypatch.setattr("os.link", lambda *_: (_ for _ in ()).throw(OSError(1, "Operation not permitted")))
    folder = FrameFolder(tmp_path, "png")
    folder.prepare({"seed": "1"}, False)
    folder.prepare({"seed": "2"}, False)
    folder.check_current({"seed": "2"})
    with pytest.raises(ls.ConfigError, match="another run with other settings has begun there"):
        folder.check_current({"seed": "1"})


@pytest.mark.deep
def test_only_one_of_two_processes_with_different_settings_gets_the_folder(tmp_path: Path) -> None:
    """All frames are of one process; the other process ends with one line and status 2."""
    for number in range(3):
        folder = tmp_path / f"{number}" / "out"
        folder.parent.mkdir()
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
        commands = [[sys.executable, "-c", PROGRAM, str(folder), kind] for kind in ("one", "other")]
        runs = [subprocess.Popen(each, env=environment, stderr=subprocess.PIPE, text=True) for each in commands]
        errors = [run.communicate()[1] for run in runs]
        statuses = [run.returncode for run in runs]
        assert sorted(statuses) == [0, 2], errors
        assert len(FakeMaker(folder).contents) == 6
        refused = errors[statuses.index(2)]
        assert "another run has begun there, which differs in kind" in refused or "settings or files (kind" in refused


PROGRAM = """
import sys
from pathlib import Path
import lumisplat as ls
from lumisplat.cli.farm.job import make_alone
from support.frame_makers import FakeMaker

nothing = lambda *_: None
try:
    job = FakeMaker(Path(sys.argv[1]), count=6, seconds=0.05, kind=sys.argv[2]).open_frames(nothing)
    make_alone(job, nothing, overwrite=False, video=None, fewer="")
except ls.LumisplatError as error:
    print(error, file=sys.stderr)
    raise SystemExit(getattr(error, "status", 2))
"""
"""Program that makes frames in a child process."""
