"""The driver of a farm: which frames are to be made, in hand, done and failed. It knows nothing of where workers run.

A worker has two frames in hand, so that it never waits for the driver; once fewer frames wait than there are workers,
one, so that none waits behind another while a worker is idle. A worker that is lost is replaced, and its frames are
given out again; only the one that it was at is held against it, and is left after the second time. So is a frame that
has failed twice. A worker that is at a frame for longer than the limit, if there is one, is ended, and counts as lost.
Frames that fail one after the other, with none done between them, end the job: then the disk is full,
or the like.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import lumisplat as ls
from lumisplat.cli.farm.executor import Done, Event, Executor, Failed, Lost, Ready, Refused, Reported, Said
from lumisplat.cli.farm.job import FrameList
from lumisplat.cli.output.console import one_line

_log = logging.getLogger("lumisplat")

TRIES = 2
"""How often a frame is tried: what kills a worker twice would kill the third."""
IN_HAND = 2
"""Frames that a worker has at once: the one that it makes, and the next."""
FAILURES_IN_A_ROW = 4
"""Failures of frames, none done between them, after which the job ends."""
STARTS_IN_A_ROW = 2
"""Workers that end before they are ready, none ready between them, after which none is started in their place."""
_WAIT_S = 1.0
"""For events, before the driver looks again, seconds."""


@dataclass
class Tally:
    """How far a job is."""

    wanted: int = 0
    """Frames that were missing when it began."""
    unit: str = "frame"
    """What one of them is called."""
    done: dict[int, float] = field(default_factory=dict[int, float])
    """Frames that are there since, and what each took of a worker, seconds."""
    failed: dict[int, BaseException] = field(default_factory=dict[int, BaseException])
    """Frames that are left, and why."""
    lost: int = 0
    """Workers that ended before their time."""

    @property
    def cost(self) -> float:
        """Mean of what a frame takes of a worker, seconds; 0 if that is not known."""
        made = [seconds for seconds in self.done.values() if seconds > 0.0]
        return sum(made) / len(made) if made else 0.0


@dataclass(frozen=True)
class FrameLimit:
    """How long a worker may be at a frame."""

    seconds: float
    name: str
    """As it was given, such as ``--frame-timeout 10m``."""
    clock: Callable[[], float] = time.monotonic
    """The time, seconds."""


@dataclass
class _Worker:
    """A worker that has not ended."""

    is_ready: bool = False
    in_hand: deque[int] = field(default_factory=deque[int])
    """The frames that it was given, in its order: it is at the first."""
    since: float = 0.0
    """When it has begun with that one."""


class Driver:
    """Gives frames to workers until each is there or has failed.

    Args:
        executor: Runs the workers.
        workers: How many there are to be.
        begin: Called once, with the frames as the first worker sees them; returns the numbers of the missing ones.
        on_progress: Called after each frame.
        on_loading: Called with a label and a fraction while workers load their scene.
        limit: How long a worker may be at a frame; None: as long as it takes.
    """

    def __init__(
        self,
        executor: Executor,
        workers: int,
        begin: Callable[[FrameList], Iterable[int]],
        on_progress: Callable[[Tally], None],
        on_loading: Callable[[str, float], None],
        *,
        limit: FrameLimit | None = None,
    ) -> None:
        self._executor, self._count = executor, workers
        self._begin, self._on_progress, self._on_loading = begin, on_progress, on_loading
        self._limit = limit
        self._workers: dict[int, _Worker] = {}
        self._waiting: deque[int] = deque()
        self._tries: dict[int, int] = {}
        self._failures = self._bad_starts = 0
        self._surrender: ls.DeviceError | None = None
        self._said: set[str] = set()
        self._refusal: BaseException | None = None
        self._refused: list[BaseException] = []
        """What no line tells yet: as long as no worker is ready, one of these may be the job's error."""
        self.frames: FrameList | None = None
        """The frames as the first worker sees them; None: none was ready yet."""
        self.tally = Tally()

    def run(self) -> Tally:
        """Makes the frames.

        Raises:
            LumisplatError: No worker can work, or the first frame shows a mistake that comes again in all.
            OSError: Likewise.
            MemoryError: Likewise.
        """
        for _ in range(self._count):
            self._start()
        while self._workers and not self._is_finished:
            for event in self._executor.events(_WAIT_S):
                self._take(event)
            self._end_hung()
        nobody = "no worker could be started" if self.frames is None else "all workers were lost"
        why = self._refusal or ls.DeviceError(nobody)
        self._say_who_refused(told=one_line(why))
        if self.frames is None:
            raise why
        self.tally.failed |= dict.fromkeys(self._waiting, why)
        return self.tally

    @property
    def _is_finished(self) -> bool:
        in_hand = any(worker.in_hand for worker in self._workers.values())
        return self.frames is not None and not self._waiting and not in_hand

    def _start(self) -> None:
        self._workers[self._executor.start()] = _Worker()

    def _take(self, event: Event) -> None:
        """Takes notice of an event; those of workers that were stopped are old."""
        if event.worker not in self._workers:
            return
        match event:
            case Ready(number, frames):
                self._greet(number, frames)
            case Refused(number, error):
                self._bad_start(number, error)
            case Done(number, frame, seconds):
                self._put_down(number, frame)
                self._failures = 0
                self.tally.done[frame] = seconds
                self._on_progress(self.tally)
            case Failed(number, frame, error, is_mistake):
                self._put_down(number, frame)
                if is_mistake and not self.tally.done:
                    raise error
                self._count_failure(frame, error)
            case Lost(number, how):
                self._bury(number, how)
            case Said(_, line):
                self._say(line)
            case Reported(_, label, fraction):
                if self.frames is None:
                    self._on_loading(label, fraction)
        self._hand_out()

    def _greet(self, number: int, frames: FrameList) -> None:
        """Takes a worker that is ready, if it sees the same frames as the first one."""
        if self.frames is None:
            self._waiting = deque(self._begin(frames))
            self.frames = frames
            self.tally.wanted, self.tally.unit = len(self._waiting), frames.unit
            self._on_progress(self.tally)
            if frames.in_sequence and self._waiting and self._count > 1:
                raise ls.ConfigError(
                    "frames of --pipeline realtime follow from those before them: workers cannot share them; render "
                    "them by --workers 1 or without farm, or choose another --pipeline"
                )
        elif frames != self.frames:
            others = {name for name, value in frames.origin.items() if self.frames.origin.get(name) != value}
            named = ", ".join(sorted(others | (self.frames.origin.keys() - frames.origin.keys()))[:3]) or "frames"
            self._bad_start(number, ls.SceneError(f"a worker sees other {named} than the first one, and is not used"))
            return
        self._workers[number].is_ready = True
        self._bad_starts = 0
        self._say_who_refused()

    def _bad_start(self, number: int, error: BaseException) -> None:
        """Lets a worker go that cannot work; the others go on."""
        del self._workers[number]
        self._executor.stop(number)
        self._refusal = error
        self._refused.append(error)
        if self.frames is not None and self._workers:
            self._say_who_refused()

    def _say_who_refused(self, told: str = "") -> None:
        """A line for each reason, but for the one that is told as the job's error."""
        for reason in map(one_line, self._refused):
            if reason != told:
                self._say(f"one worker fewer: {reason}")
        self._refused.clear()

    def _put_down(self, number: int, frame: int) -> None:
        """Takes what a worker has done from its hand: it begins with the next."""
        self._workers[number].in_hand.remove(frame)
        self._workers[number].since = self._now()

    def _now(self) -> float:
        return self._limit.clock() if self._limit is not None else 0.0

    def _end_hung(self) -> None:
        """Ends workers that are at a frame for too long."""
        if (limit := self._limit) is None:
            return
        for number, worker in list(self._workers.items()):
            if worker.in_hand and limit.clock() - worker.since > limit.seconds:
                self._executor.stop(number)
                how = f"it takes longer than {limit.name}"
                self._bury(number, f"{how}, and was ended", ls.DeviceError(how))
                self._hand_out()

    @property
    def _unit(self) -> str:
        return "frame" if self.frames is None else self.frames.unit

    def _bury(self, number: int, how: str, error: BaseException | None = None) -> None:
        """Gives out again what a lost worker had in hand, and starts another in its place.

        Args:
            number: The worker's.
            how: What is known of its end.
            error: Why the frame that it was at is left, if it is; None: for its end.
        """
        worker = self._workers.pop(number)
        self.tally.lost += 1
        if not worker.is_ready:
            self._bad_starts += 1
            self._refusal = ls.DeviceError(f"a worker ended before it was ready: {how}")
        rest = worker.in_hand
        at = rest.popleft() if rest else None
        self._waiting.extendleft(reversed(rest))
        doing = f", at {self._unit} {at}" if at is not None else ""
        _log.warning("a worker was lost (%s)%s", how, doing)
        if at is not None:
            self._count_failure(at, error or ls.DeviceError(f"a worker was lost: {how}"))
        if self._bad_starts < STARTS_IN_A_ROW and not self._is_finished:
            self._start()

    def _count_failure(self, frame: int, error: BaseException) -> None:
        """Tries a frame again, later, or leaves it."""
        self._failures += 1
        self._tries[frame] = self._tries.get(frame, 0) + 1
        if self._tries[frame] < TRIES:
            self._waiting.append(frame)
        else:
            self.tally.failed[frame] = error
            self._on_progress(self.tally)
        if self._failures >= FAILURES_IN_A_ROW:
            if self._surrender is None:
                how = f"given up after {FAILURES_IN_A_ROW} failures in a row, the last: {one_line(error)}"
                self._surrender = ls.DeviceError(how)
            self.tally.failed |= dict.fromkeys(self._waiting, self._surrender)
            self._waiting.clear()

    def _hand_out(self) -> None:
        """Gives frames to workers that have room for them, the idle ones first."""
        ready = [(number, worker) for number, worker in self._workers.items() if worker.is_ready]
        for depth in range(1, IN_HAND + 1):
            for number, worker in ready:
                may_wait = depth == 1 or len(self._waiting) >= len(ready)
                if len(worker.in_hand) < depth and may_wait and (frame := self._next()) is not None:
                    worker.since = worker.since if worker.in_hand else self._now()
                    worker.in_hand.append(frame)
                    self._executor.submit(number, frame)

    def _next(self) -> int | None:
        """The first frame that waits, and for no other; those that wait for one that has failed, fail."""
        assert self.frames is not None
        if not self.frames.needs:
            return self._waiting.popleft() if self._waiting else None
        undone = {*self._waiting, *(frame for worker in self._workers.values() for frame in worker.in_hand)}
        for frame in list(self._waiting):
            needs = self.frames.needs.get(frame, ())
            if failed := [need for need in needs if need in self.tally.failed]:
                self._waiting.remove(frame)
                self.tally.failed[frame] = self.tally.failed[failed[0]]
            elif undone.isdisjoint(needs):
                self._waiting.remove(frame)
                return frame
        return None

    def _say(self, line: str) -> None:
        """Logs a line, once, whichever worker says it."""
        if line not in self._said:
            self._said.add(line)
            _log.warning("%s", line)
