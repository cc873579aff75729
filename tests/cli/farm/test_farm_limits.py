"""Workers that hang at a frame: they are ended, the frame is tried once more, and all others are there."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from lumisplat.cli import main
from lumisplat.cli.farm.driver import Driver, FrameLimit
from lumisplat.cli.farm.executor import Done, Event, Ready
from lumisplat.cli.farm.failed_frames import FramesMissingError
from lumisplat.cli.farm.job import FrameList
from lumisplat.cli.farm.places import FarmRoom
from lumisplat.cli.farm.run import FarmRun
from lumisplat.cli.farm.worker import Order
from lumisplat.cli.output.frame_folder import FrameFolder
from support.frame_makers import FakeMaker

TWO = FarmRoom(workers=2, cores=1, device="cpu")


class Clock:
    """The time, as a test sets it."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        """In seconds."""
        return self.now


class OneWorker:
    """An executor whose only living worker answers when it is told to."""

    def __init__(self) -> None:
        self.started, self.given, self.stopped = 0, list[tuple[int, int]](), list[int]()

    def start(self) -> int:
        """Another worker."""
        self.started += 1
        return self.started - 1

    def submit(self, worker: int, frame: int) -> None:
        """Notes what was given to whom."""
        self.given.append((worker, frame))

    def stop(self, worker: int) -> None:
        """Notes who was ended."""
        self.stopped.append(worker)

    def events(self, timeout: float) -> Sequence[Event]:
        """None."""
        return []

    def close(self) -> None:
        """Nothing."""


def begun(count: int, seconds: float) -> tuple[Driver, OneWorker, Clock]:
    """A driver whose worker is ready, and has begun."""
    executor, clock = OneWorker(), Clock()
    limit = FrameLimit(seconds, f"--frame-timeout {seconds:g}s", clock)
    run = Driver(executor, 1, lambda frames: frames.wanted, lambda _: None, lambda *_: None, limit=limit)
    run._start()
    run._take(Ready(0, frame_list(count)))
    return run, executor, clock


def frame_list(count: int) -> FrameList:
    """So many frames."""
    return FrameList(folder=FrameFolder(Path("out"), "png"), origin={}, wanted=tuple(range(count)))


def test_time_counts_from_the_frame_before() -> None:
    """A frame that waits in a worker's hand has not begun: each has its own time."""
    run, executor, clock = begun(6, 10.0)
    for frame in range(4):
        clock.now += 9.0
        run._end_hung()
        run._take(Done(0, frame, 9.0))
    assert not executor.stopped and sorted(run.tally.done) == [0, 1, 2, 3]


def test_a_worker_that_hangs_is_replaced() -> None:
    """Its frame comes again, last; the one that waited for it first. After the second time it is left."""
    run, executor, clock = begun(4, 10.0)
    clock.now += 10.5
    run._end_hung()
    assert executor.stopped == [0] and executor.started == 2 and run.tally.lost == 1
    run._take(Ready(1, frame_list(4)))
    assert executor.given == [(0, 0), (0, 1), (1, 1), (1, 2)]
    for frame in (1, 2, 3):
        run._take(Done(1, frame, 1.0))
    assert executor.given[-1] == (1, 0)
    clock.now += 10.5
    run._end_hung()
    assert str(run.tally.failed[0]) == "it takes longer than --frame-timeout 10s"
    assert run._is_finished and executor.started == 2


def test_a_worker_that_waits_is_not_ended() -> None:
    """Neither one that has nothing in hand, nor one that loads its scene."""
    run, executor, clock = begun(1, 10.0)
    run._take(Done(0, 0, 1.0))
    run._start()
    clock.now += 1000.0
    run._end_hung()
    assert not executor.stopped


def test_frames_that_hang(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """One hangs once and is made by another worker; one hangs always, and is named; no process stays."""
    maker = FakeMaker(tmp_path / "out", count=8, wrong={2: "hang"})
    order, limit = Order(maker, os.getcwd()), FrameLimit(1.0, "--frame-timeout 1s")
    lines = FarmRun(order, "local", TWO, lambda *_: None, overwrite=False, video=None, limit=limit).run()
    assert len(maker.contents) == 8 and maker.begun == [0, 1, 2, 2, 3, 4, 5, 6, 7]
    assert "1 worker lost and replaced" in lines
    assert "a worker was lost (it takes longer than --frame-timeout 1s, and was ended), at frame 2" in caplog.messages
    always = FakeMaker(tmp_path / "other" / "out", count=3, wrong={1: "hang"}, again=True)
    always.folder.parent.mkdir()
    order = Order(always, os.getcwd())
    with pytest.raises(FramesMissingError, match=r"^frame 1: it takes longer than --frame-timeout 1s; .* 2 of 3"):
        FarmRun(order, "local", TWO, lambda *_: None, overwrite=False, video=None, limit=limit).run()
    hung = {int(path.name.split("_")[1]) for path in tmp_path.rglob("made/[12]_*")}
    for _ in range(100):
        if not any(Path(f"/proc/{pid}").exists() for pid in hung):
            break
        time.sleep(0.05)
    assert not any(Path(f"/proc/{pid}").exists() for pid in hung)


def test_an_error_of_ours_is_said_in_its_words(tmp_path: Path) -> None:
    """What is no mistake of the user: its kind, its words and its place, for the frame; the worker goes on."""
    maker = FakeMaker(tmp_path / "out", count=4, wrong={1: "bug"}, again=True)
    with pytest.raises(
        FramesMissingError, match=r"^frame 1: ValueError: shapes differ, in .*frame_makers\.py, line \d+;"
    ):
        FarmRun(Order(maker, os.getcwd()), "local", TWO, lambda *_: None, overwrite=False, video=None).run()
    assert len({path.name.split("_")[1] for path in (tmp_path / "made").iterdir()}) <= 2


@pytest.mark.parametrize("text", ["soon", "0s", "-3"])
def test_a_limit_that_is_no_time(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, before anything is started."""
    command = ["farm", "orbit", str(tmp_path / "garden.ply"), "-o", str(tmp_path / "out"), f"--frame-timeout={text}"]
    assert main(command) == 2
    assert f"--frame-timeout is '{text}', expected a time such as 90s, 10m or 1.5h" in capsys.readouterr().err
