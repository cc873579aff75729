"""The driver of a farm, over an executor that does as it is told: no frame is lost, none is made twice without need."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lumisplat as ls
from lumisplat.cli.farm.driver import FAILURES_IN_A_ROW, TRIES, Driver, Tally
from lumisplat.cli.farm.executor import Done, Event, Failed, Lost, Ready, Refused, Reported, Said
from lumisplat.cli.farm.job import FrameList
from lumisplat.cli.output.frame_folder import FrameFolder

FULL = ls.FormatError("out/frame_0001.png", "cannot be written: No space left on device")


def frame_list(count: int, **changes: object) -> FrameList:
    """So many frames of one origin."""
    origin = {"scene": "garden.ply"} | {name: str(value) for name, value in changes.items() if name == "scene"}
    sequence = bool(changes.get("in_sequence"))
    return FrameList(
        folder=FrameFolder(Path("out"), "png"), origin=origin, wanted=tuple(range(count)), in_sequence=sequence
    )


class FakeExecutor:
    """Workers that answer when a test lets them."""

    def __init__(self) -> None:
        self.queues: dict[int, list[int]] = {}
        """What each living worker has in hand."""
        self.given: Counter[int] = Counter()
        """How often each frame was given out."""
        self.coming: list[Event] = []
        self.started = 0
        self.stopped: list[int] = []
        self.most_in_hand = 0

    def start(self) -> int:
        """Another worker."""
        self.queues[self.started] = []
        self.started += 1
        return self.started - 1

    def submit(self, worker: int, frame: int) -> None:
        """Gives a worker a frame."""
        self.given[frame] += 1
        self.queues[worker].append(frame)
        self.most_in_hand = max(self.most_in_hand, len(self.queues[worker]))

    def stop(self, worker: int) -> None:
        """Ends a worker."""
        self.stopped.append(worker)
        self.queues.pop(worker, None)

    def events(self, timeout: float) -> Sequence[Event]:
        """What the test has put there; else each worker does its first frame."""
        if self.coming:
            events, self.coming = self.coming, []
            return events
        return [self.done(worker) for worker, queue in self.queues.items() if queue]

    def close(self) -> None:
        """Nothing."""

    def done(self, worker: int) -> Done:
        """A worker finishes what it is at."""
        return Done(worker, self.queues[worker].pop(0), 2.0)

    def lost(self, worker: int) -> Lost:
        """A worker dies."""
        del self.queues[worker]
        return Lost(worker, "killed by SIGKILL")


def driver(executor: FakeExecutor, workers: int, missing: Sequence[int]) -> tuple[Driver, list[Tally]]:
    """A driver of frames that are missing, and what it has shown."""
    shown: list[Tally] = []
    return Driver(executor, workers, lambda _: missing, shown.append, lambda *_: None), shown


def test_each_frame_is_given_out_once() -> None:
    """To two workers, which have two in hand, and one when the end is near."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(20)), Ready(1, frame_list(20))]
    run, shown = driver(executor, 2, range(20))
    tally = run.run()
    assert sorted(tally.done) == list(range(20)) and not tally.failed
    assert set(executor.given.values()) == {1}
    assert executor.most_in_hand == 2
    assert tally.cost == 2.0 and len(shown) == 21


def test_frames_that_are_there_are_not_given_out() -> None:
    """Only the missing ones are; with none missing, nothing is done."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(20))]
    run, _ = driver(executor, 1, [3, 17])
    assert sorted(run.run().done) == [3, 17]
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(20))]
    run, _ = driver(executor, 1, [])
    assert run.run() == Tally() and not executor.given


def test_the_last_frames_do_not_queue_behind_others() -> None:
    """Three frames for two workers: one each and one waiting, until one of them is idle."""
    executor = FakeExecutor()
    run, _ = driver(executor, 2, range(3))
    run._start()
    run._start()
    run._take(Ready(0, frame_list(3)))
    run._take(Ready(1, frame_list(3)))
    assert [len(queue) for queue in executor.queues.values()] == [2, 1]
    run._take(executor.done(1))
    assert [len(queue) for queue in executor.queues.values()] == [2, 0]
    executor = FakeExecutor()
    run, _ = driver(executor, 2, range(4))
    run._start()
    run._start()
    run._take(Ready(1, frame_list(4)))
    run._take(Ready(0, frame_list(4)))
    assert list(executor.queues.values()) == [[2], [0, 1]]


def test_a_lost_worker_is_replaced_and_its_frames_are_given_out_again() -> None:
    """What it was at counts once against that frame, what it had not begun against none."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9))]
    run, _ = driver(executor, 1, range(9))
    run._start()
    for event in executor.events(0.0):
        run._take(event)
    assert executor.queues[0] == [0, 1]
    run._take(executor.lost(0))
    assert executor.started == 2
    run._take(Ready(1, frame_list(9)))
    assert executor.queues[1] == [1, 2]  # that which it was at comes last
    while not run._is_finished:
        for event in executor.events(0.0):
            run._take(event)
    assert sorted(run.tally.done) == list(range(9)) and run.tally.lost == 1
    assert executor.given == Counter({0: 2, 1: 2} | dict.fromkeys(range(2, 9), 1))


def test_a_frame_that_waited_for_a_lost_worker_has_its_two_tries() -> None:
    """It has not begun: only the next loss, in which it is the one at hand, counts."""
    executor = FakeExecutor()
    run, _ = driver(executor, 1, range(9))
    run._start()
    run._take(Ready(0, frame_list(9)))
    run._take(executor.lost(0))
    run._take(Ready(1, frame_list(9)))
    assert executor.queues[1] == [1, 2]
    run._take(executor.lost(1))
    assert not run.tally.failed and run._tries == {0: 1, 1: 1}


def test_a_frame_that_kills_twice_is_left() -> None:
    """And reported; all others are there."""
    executor = FakeExecutor()
    run, _ = driver(executor, 2, range(9))
    run._start()
    run._start()
    run._take(Ready(0, frame_list(9)))
    run._take(Ready(1, frame_list(9)))
    while not run._is_finished:
        at = next((worker for worker, queue in executor.queues.items() if queue and queue[0] == 4), None)
        if at is not None:
            run._take(executor.lost(at))
            run._take(Ready(executor.started - 1, frame_list(9)))
        for event in executor.events(0.0):
            if not (isinstance(event, Done) and event.frame == 4):
                run._take(event)
            else:
                executor.queues[event.worker].insert(0, 4)
    assert set(run.tally.failed) == {4} and executor.given[4] == TRIES
    assert "killed by SIGKILL" in str(run.tally.failed[4])
    assert sorted(run.tally.done) == [0, 1, 2, 3, 5, 6, 7, 8]


def test_failures_in_a_row_end_the_job() -> None:
    """As of a full disk: a hundred frames are not tried; one that succeeds between them lets it go on."""
    executor = FakeExecutor()
    run, _ = driver(executor, 1, range(100))
    run._start()
    run._take(Ready(0, frame_list(100)))
    run._take(executor.done(0))
    while not run._is_finished:
        run._take(Failed(0, executor.queues[0].pop(0), FULL, False))
    assert executor.given.total() <= FAILURES_IN_A_ROW + 2
    assert set(run.tally.failed) | set(run.tally.done) == set(range(100))
    executor = FakeExecutor()
    run, _ = driver(executor, 1, range(20))
    run._start()
    run._take(Ready(0, frame_list(20)))
    while not run._is_finished:
        frame = executor.queues[0][0]
        if frame % 2 and frame not in run.tally.failed:
            executor.queues[0].pop(0)
            run._take(Failed(0, frame, FULL, False))
        else:
            run._take(executor.done(0))
        if executor.given.total() > 200:
            break
    assert set(run.tally.done) | set(run.tally.failed) == set(range(20)) and len(run.tally.done) == 10


def test_a_mistake_in_the_first_frame_ends_the_job_at_once() -> None:
    """It would come again in all; after a frame that is done, it is that frame's."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9)), Failed(0, 0, ls.ConfigError("samples is 0"), True)]
    run, _ = driver(executor, 1, range(9))
    with pytest.raises(ls.ConfigError, match="samples is 0"):
        run.run()


def test_workers_that_cannot_start() -> None:
    """If none can, their error is the job's; if some can, the others do the work."""
    executor = FakeExecutor()
    executor.coming = [Refused(0, ls.MissingFileError("lost.ply", "no such file")), Refused(1, MemoryError())]
    run, _ = driver(executor, 2, range(9))
    with pytest.raises(MemoryError):
        run.run()
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9)), Refused(1, MemoryError())]
    run, _ = driver(executor, 2, range(9))
    assert len(run.run().done) == 9 and executor.stopped == [1]


def test_workers_that_die_before_they_are_ready_are_not_replaced_for_ever() -> None:
    """Two in a row are enough."""
    executor = FakeExecutor()
    run, _ = driver(executor, 1, range(9))
    run._start()
    run._take(executor.lost(0))
    run._take(executor.lost(1))
    assert executor.started == 2 and not run._workers
    with pytest.raises(ls.DeviceError, match="a worker ended before it was ready: killed by SIGKILL"):
        executor = FakeExecutor()
        executor.coming = [Lost(0, "killed by SIGKILL")]
        executor.events = lambda timeout: [Lost(executor.started - 1, "killed by SIGKILL")]  # pyright: ignore
        run, _ = driver(executor, 1, range(9))
        run.run()


def test_one_that_is_ready_ends_a_row_of_bad_starts() -> None:
    """A worker that dies as it starts, one that works, and another that dies: that one is replaced, too."""
    executor = FakeExecutor()
    run, _ = driver(executor, 1, range(9))
    run._start()
    run._take(executor.lost(0))
    run._take(Ready(1, frame_list(9)))
    run._take(executor.lost(1))
    run._take(executor.lost(2))
    assert executor.started == 4 and list(run._workers) == [3]


def test_when_a_file_vanishes_the_living_workers_go_on(caplog: pytest.LogCaptureFixture) -> None:
    """A successor that cannot load the scene is done without; with nobody left, the rest of the frames say why."""
    executor = FakeExecutor()
    run, _ = driver(executor, 2, range(9))
    run._start()
    run._start()
    run._take(Ready(0, frame_list(9)))
    run._take(Ready(1, frame_list(9)))
    run._take(executor.lost(1))
    run._take(Refused(2, ls.MissingFileError("garden.ply", "no such file")))
    assert "one worker fewer: garden.ply: no such file" in caplog.messages
    run._take(executor.done(0))
    run._take(executor.lost(0))
    run._take(Refused(3, ls.MissingFileError("garden.ply", "no such file")))
    assert not run._workers and set(run.tally.done) == {0}


def test_what_all_workers_refuse_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    """As the error: no line before it says the same of one worker. If another one works, it is a line."""
    executor = FakeExecutor()
    refused = ls.FormatError("out", "cannot be written: Read-only file system")
    executor.coming = [Refused(0, refused), Refused(1, refused)]
    run, _ = driver(executor, 2, range(9))
    with pytest.raises(ls.FormatError, match="Read-only"):
        run.run()
    assert not caplog.messages
    executor = FakeExecutor()
    executor.coming = [Refused(0, refused), Ready(1, frame_list(9))]
    assert len(driver(executor, 2, range(9))[0].run().done) == 9
    assert caplog.messages == ["one worker fewer: out: cannot be written: Read-only file system"]


def test_every_reason_why_workers_refuse_is_said(caplog: pytest.LogCaptureFixture) -> None:
    """Once each, also if none works: the last is the error, and those before it are lines, lost workers' included."""
    executor = FakeExecutor()
    full, missing = ls.FormatError("out", "cannot be written: No space left on device"), ls.DeviceError("no GPU")
    executor.coming = [Refused(0, missing), Refused(1, full), Refused(2, missing), Refused(3, full)]
    with pytest.raises(ls.FormatError, match="No space left"):
        driver(executor, 4, range(9))[0].run()
    assert caplog.messages == ["one worker fewer: no GPU"]
    caplog.clear()
    executor = FakeExecutor()
    killed = "killed by SIGKILL"
    executor.coming = [Refused(0, missing), Lost(1, killed), Lost(2, killed)]
    with pytest.raises(ls.DeviceError, match="ended before it was ready"):
        driver(executor, 2, range(9))[0].run()
    assert caplog.messages[-1] == "one worker fewer: no GPU"


def test_a_worker_that_sees_other_files_is_not_used(caplog: pytest.LogCaptureFixture) -> None:
    """A mixed film is worse than a slow one; the line says what differs."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9)), Ready(1, frame_list(9, scene="older.ply"))]
    run, _ = driver(executor, 2, range(9))
    assert len(run.run().done) == 9
    assert executor.stopped == [1]
    assert "a worker sees other scene than the first one" in caplog.text


def test_sequences_are_not_shared() -> None:
    """Frames in real time follow from each other; a single worker makes them."""
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9, in_sequence=True))]
    run, _ = driver(executor, 2, range(9))
    with pytest.raises(ls.ConfigError, match="workers cannot share them"):
        run.run()
    executor = FakeExecutor()
    executor.coming = [Ready(0, frame_list(9, in_sequence=True))]
    run, _ = driver(executor, 1, range(9))
    assert len(run.run().done) == 9


def test_lines_of_workers_are_said_once(caplog: pytest.LogCaptureFixture) -> None:
    """Whichever say them."""
    executor = FakeExecutor()
    executor.coming = [
        Reported(0, "loading", 0.5), Said(0, "grainy"), Ready(0, frame_list(2)), Said(1, "grainy"), Said(1, "dark"),
    ]  # fmt: skip
    run, _ = driver(executor, 2, range(2))
    run.run()
    assert caplog.messages == ["grainy", "dark"]


@given(
    seed=st.randoms(use_true_random=False),
    count=st.integers(1, 30),
    workers=st.integers(1, 4),
    trouble=st.floats(0.0, 0.3),
)
def test_no_frame_is_lost_whatever_happens(seed, count: int, workers: int, trouble: float) -> None:
    """Each is done or has failed, never both; none is given out after it is done, nor more often than it may be."""
    executor = FakeExecutor()
    run, _ = driver(executor, workers, range(count))
    for _ in range(workers):
        run._start()
    waiting = set(range(workers))
    for _ in range(2000):
        if run._is_finished or not run._workers:
            break
        for number in [number for number in executor.queues if number not in run._workers]:
            raise AssertionError(f"worker {number} lives unknown")
        waiting = {number for number, worker in run._workers.items() if not worker.is_ready}
        number = seed.choice(list(run._workers))
        if number in waiting:
            run._take(Ready(number, frame_list(count)))
        elif seed.random() < trouble:
            run._take(executor.lost(number))
        elif executor.queues[number] and seed.random() < trouble:
            run._take(Failed(number, executor.queues[number].pop(0), FULL, False))
        elif executor.queues[number]:
            run._take(executor.done(number))
            assert not set(executor.queues.get(number, [])) & set(run.tally.done)
    assert not set(run.tally.done) & set(run.tally.failed)
    assert set(run.tally.done) | set(run.tally.failed) == set(range(count))


def test_frames_of_others_come_after_these() -> None:
    """They wait while one of theirs is in hand, of which workers that have nothing else do not make another."""
    executor = FakeExecutor()
    frames = replace(frame_list(5), needs={2: (0, 1), 4: (3,)})
    executor.coming = [Ready(0, frames), Ready(1, frames)]
    run, _ = driver(executor, 2, [2, 0, 1, 4, 3])
    order: list[int] = []
    events = executor.events

    def watched(timeout: float) -> Sequence[Event]:
        found = events(timeout)
        order.extend(event.frame for event in found if isinstance(event, Done))
        return found

    executor.events = watched
    tally = run.run()
    assert sorted(tally.done) == [0, 1, 2, 3, 4] and not tally.failed
    assert order.index(2) > max(order.index(0), order.index(1)) and order.index(4) > order.index(3)


def test_frames_of_others_fail_with_these() -> None:
    """What a frame is made of has failed: so does it, and the job ends."""
    executor = FakeExecutor()
    frames = replace(frame_list(3), needs={2: (0, 1)})
    executor.coming = [Ready(0, frames)]
    run, _ = driver(executor, 1, range(3))
    events = executor.events

    def failing(timeout: float) -> Sequence[Event]:
        found = events(timeout)
        return [Failed(0, 0, FULL, False) if isinstance(event, Done) and event.frame == 0 else event for event in found]

    executor.events = failing
    tally = run.run()
    assert sorted(tally.done) == [1] and sorted(tally.failed) == [0, 2]
