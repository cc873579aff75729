"""The driver of ``lumisplat farm``: assigns frames to worker processes until each frame exists or has failed.

Ray starts the workers, gives each its own GPU if there are any, and reports when a worker ends. The driver replaces
lost workers, and tries failed frames once more. Several failures in a row, without a finished frame between them, end
the job, because problems such as a full disk affect all frames.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.farm.cluster import LOCAL, actor_failure, connected, usable_cores
from lumisplat.cli.farm.job import FrameList, FrameMaker, finish_frames
from lumisplat.cli.farm.worker import Answer, Order, Worker
from lumisplat.cli.input.numbers import seconds_of
from lumisplat.cli.output.console import Report, counted, duration_text, one_line, progress_bars
from lumisplat.cli.output.frame_folder import check_video
from lumisplat.cli.output.images import refuse_standard_output

_log = logging.getLogger("lumisplat")

CORES = 4
"""Without GPUs and ``--cores``, the default number of workers is that of all CPU cores divided by this number."""
TRIES = 2
"""Number of times that a frame is tried: one that ends two workers would probably end a third."""
FAILURES_IN_A_ROW = 4
"""Number of failures, of any frames, without a finished frame between them, after which the job gives up."""
STARTS_IN_A_ROW = 2
"""Number of workers that end while they start, one after the other, after which no more are started."""
_WAIT_S = 1.0
"""Interval at which the driver checks the time limits of frames if no worker answers, seconds."""


@dataclass(frozen=True, kw_only=True)
class FarmOptions:
    """Options of ``lumisplat farm``: number of worker processes, their cores, time limit and cluster."""

    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one per GPU, else per 4 cores)")] = (
        None
    )
    """Start N processes, each of which loads the scene."""
    cores: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: an equal share)")] = None
    """Give each worker N CPU cores."""
    frame_timeout: Annotated[str | None, arg(metavar="TIME", help_behavior_hint="(default: no limit)")] = None
    """Replace a worker whose frame takes longer than this: 90s, 10m, 1.5h."""
    address: Annotated[str, arg(metavar="local|auto|ray://HOST:PORT")] = "local"
    """Start Ray here (local), use the cluster running here (auto), or ray://HOST:PORT."""


FarmGroup = Annotated[FarmOptions, arg(name="farm"), OmitArgPrefixes]
"""Type of a command field whose `FarmOptions` become options of the command, in a help group of their own."""


class FarmCommand(FrameMaker, Protocol):
    """Interface of a command whose frames worker processes can make."""

    @property
    def output(self) -> Path | None:
        """Value of ``-o``, the folder or file to write; None without it."""
        ...

    @property
    def device(self) -> str:
        """Value of ``--device``."""
        ...

    @property
    def debug(self) -> bool:
        """Value of ``--debug``."""
        ...

    @property
    def farm(self) -> FarmOptions:
        """Options of the worker processes."""
        ...


def run_farm(command: FarmCommand, *, overwrite: bool, video: Path | None) -> None:
    """Makes the missing frames of a command with worker processes, then the video, and prints a summary.

    Args:
        command: The command.
        overwrite: True deletes existing frames first.
        video: Path of the video; None writes no video.

    Raises:
        ConfigError: An option is wrong, or there is no cluster.
        KeyboardInterrupt: The command was interrupted; the message counts the existing frames.
        FramesMissingError: Some frames failed.
        LumisplatError: A setting or the scene is wrong.
    """
    refuse_standard_output(command.output)
    options = command.farm
    if getattr(command, "stats", False):
        raise ls.ConfigError("--stats needs one process: run the command without farm")
    for name, value in (("workers", options.workers), ("cores", options.cores)):
        if value is not None and value < 1:
            raise ls.ConfigError(f"--{name} is {value}, expected 1 or more")
    if options.frame_timeout is not None:
        seconds_of("--frame-timeout", options.frame_timeout)
    order = Order(command, os.getcwd(), command.debug)
    cpus = max(usable_cores(), (options.workers or 1) * (options.cores or 1))
    with connected(options.address, cpus) as ray, progress_bars() as report:
        lines = Driver(ray, order, options, command.device, report, overwrite=overwrite, video=video).run()
    print(lines)


@dataclass
class _Task:
    """Task of a worker: loading the scene, or making a frame."""

    worker: Any
    frame: int | None
    """Number of the frame that the worker makes; None while it loads the scene."""
    since: float
    """Time at which the worker began, seconds of `Driver.clock`."""


@dataclass
class Driver:
    """Runs one job of ``lumisplat farm``: starts worker processes, assigns frames to them, and replaces lost ones."""

    ray: Any
    """The module ``ray``, connected to a cluster."""
    order: Order
    options: FarmOptions
    device: str
    report: Report
    overwrite: bool = field(kw_only=True)
    video: Path | None = field(kw_only=True)
    clock: Callable[[], float] = field(default=time.monotonic, kw_only=True)

    def __post_init__(self) -> None:
        self._frames: FrameList | None = None
        """Frames of the command, which the first worker that has loaded the scene reports; None until then."""
        self._wanted = 0
        self._waiting: deque[int] = deque()
        self._tasks: dict[Any, _Task] = {}
        self._idle: list[Any] = []
        self._done: dict[int, float] = {}
        """Time that a worker took for each finished frame, seconds, by frame number; 0 if the frame already existed."""
        self._failed: dict[int, BaseException] = {}
        self._tries: dict[int, int] = {}
        self._lost = self._failures = self._bad_starts = 0
        self._refusals: list[BaseException] = []
        """Errors of workers that could not load the scene, not logged yet. They become warnings once another worker
        can; if none can, the last one ends the job."""
        self._refusal: BaseException | None = None
        self._logged: set[str] = set()

    def run(self) -> str:
        """Makes the missing frames with worker processes, then the video.

        Returns:
            Summary lines about the frames and their time.

        Raises:
            KeyboardInterrupt: The command was interrupted; the message counts the existing frames.
            FramesMissingError: Some frames failed.
            LumisplatError: No worker could start, or the first frame has a mistake that all frames share.
        """
        begun = self.clock()
        count, needs, threads = self._resources()
        actor = self.ray.remote(max_restarts=0, max_task_retries=0, **needs)(Worker)
        self._make_worker: Callable[[], Any] = lambda: actor.remote(self.order, threads)
        self._count = count
        self.report(f"starting {counted(count, 'worker')}", 0.0)
        try:
            for _ in range(count):
                self._start()
            while self._tasks and not self._is_finished:
                answered, _ = self.ray.wait(list(self._tasks), num_returns=1, timeout=_WAIT_S)
                for ref in answered:
                    self._receive(ref)
                self._end_hung()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(*([self._frames.count_line(self.overwrite)] if self._frames else [])) from None
        finally:
            for worker in [*self._idle, *(task.worker for task in self._tasks.values())]:
                self.ray.kill(worker)
        return self._summary(begun)

    def _resources(self) -> tuple[int, dict[str, float], int]:
        """Returns the number of workers, the Ray resources that each reserves, and its number of CPU threads.

        A worker reserves one GPU if there are any, else its CPU cores. In a cluster, workers that do not fit wait for
        new nodes; on one machine, several workers may share a GPU.
        """
        here = self.options.address == LOCAL
        resources = self.ray.cluster_resources()
        gpus = int(resources.get("GPU", 0)) if self.device in ("auto", "cuda") else 0
        cpus = int(resources.get("CPU", 1))
        count = self.options.workers or gpus or max(1, cpus // (self.options.cores or CORES))
        cores = self.options.cores or max(1, cpus // count if here else min(CORES, cpus // count))
        share = 1.0 / -(-count // gpus) if gpus and here else 1.0
        return count, {"num_gpus": share, "num_cpus": 1} if gpus else {"num_cpus": cores}, cores

    def _summary(self, begun: float) -> str:
        """Returns summary lines if all frames exist; raises the error of the job otherwise.

        Args:
            begun: Start time of the job, seconds of `Driver.clock`.
        """
        why = self._refusal or ls.DeviceError(
            "no worker could be started" if self._frames is None else "all workers were lost"
        )
        self._log_refusals(reported=one_line(why))
        if (frames := self._frames) is None:
            raise why
        self._failed |= dict.fromkeys(self._waiting, why)
        missing = {index: error for index, error in self._failed.items() if not frames.folder.is_finished(index)}
        for index in self._done:
            if not frames.folder.is_finished(index) and not frames.folder.is_stopped(index):
                missing[index] = ls.SceneError(
                    "missing, although a worker has written it: check that all workers see the same folder"
                )
        if missing:
            raise frames.missing_error(missing, self.overwrite)
        lines = finish_frames(frames, len(self._done), self.video, self.report)
        if not self._done:
            return lines
        lost = f", {counted(self._lost, 'worker')} lost and replaced" if self._lost else ""
        return (
            f"{lines}\n{counted(len(self._done), frames.unit)} by {counted(self._count, 'worker')} in "
            f"{duration_text(self.clock() - begun)}, {self._mean_seconds:.3g} s per {frames.unit} on one worker{lost}"
        )

    @property
    def _mean_seconds(self) -> float:
        """Mean time that one worker takes for a frame, seconds; 0 until a frame has been made."""
        made = [seconds for seconds in self._done.values() if seconds > 0.0]
        return sum(made) / len(made) if made else 0.0

    @property
    def _is_finished(self) -> bool:
        at_frames = any(task.frame is not None for task in self._tasks.values())
        return self._frames is not None and not self._waiting and not at_frames

    def _start(self) -> None:
        worker = self._make_worker()
        self._tasks[worker.open.remote()] = _Task(worker, None, self.clock())

    def _receive(self, ref: Any) -> None:
        """Handles a worker's result, scene loaded or frame made; replaces the worker if its process was lost.

        Args:
            ref: Ray reference of the finished call.
        """
        task = self._tasks.pop(ref)
        try:
            answer: Answer = self.ray.get(ref)
        except self.ray.exceptions.RayError as error:
            self._replace_worker(task, actor_failure(error))
        else:
            for line in answer.lines:
                self._log_once(line)
            if answer.error is not None and answer.host != socket.gethostname():
                answer.error.add_note(f"on {answer.host}")
            if task.frame is None:
                self._worker_ready(task.worker, answer)
            else:
                self._frame_done(task.worker, task.frame, answer)
        self._assign_frames()

    def _worker_ready(self, worker: Any, answer: Answer) -> None:
        """Marks a worker that has loaded the scene as idle; refuses it if that failed or its frames differ."""
        if answer.frames is None:
            assert answer.error is not None
            self._refuse(worker, answer.error)
            return
        if self._frames is None:
            self._begin(answer.frames)
        elif answer.frames != self._frames:
            ours, theirs = self._frames.provenance, answer.frames.provenance
            others = {name for name in ours | theirs if ours.get(name) != theirs.get(name)}
            named = ", ".join(sorted(others)[:3]) or "frames"
            self._refuse(worker, ls.SceneError(f"a worker differs from the first one in {named}, and is not used"))
            return
        self._idle.append(worker)
        self._bad_starts = 0
        self._log_refusals()

    def _begin(self, frames: FrameList) -> None:
        """Takes over the frames that the first ready worker reports; prepares their folder and queues missing ones."""
        self.report("starting", 1.0)
        if self.video is not None:
            check_video(self.video, frames.fps or 0.0)
        self._waiting = deque(frames.begin(self.overwrite))
        self._frames, self._wanted = frames, len(self._waiting)
        self._report_progress()
        if frames.in_sequence and self._waiting and self._count > 1:
            raise ls.ConfigError(
                "frames of --pipeline realtime depend on those before them, so workers cannot share them: render "
                "with --workers 1 or without farm, or choose another --pipeline"
            )

    def _refuse(self, worker: Any, error: BaseException) -> None:
        """Ends a worker that could not load the scene, and keeps its error; the other workers continue."""
        self.ray.kill(worker)
        self._refusal = error
        self._refusals.append(error)
        if self._frames is not None and (self._idle or self._tasks):
            self._log_refusals()

    def _log_refusals(self, reported: str = "") -> None:
        """Logs why workers could not load the scene; skips the reason ``reported``, which the job's error repeats."""
        for reason in map(one_line, self._refusals):
            if reason != reported:
                self._log_once(f"a worker could not start: {reason}")
        self._refusals.clear()

    def _frame_done(self, worker: Any, frame: int, answer: Answer) -> None:
        """Records that a worker has made a frame or failed to, and marks the worker as idle.

        If the job's first frame fails by a mistake that all frames share, raises its error.
        """
        self._idle.append(worker)
        if answer.error is None:
            self._failures = 0
            self._done[frame] = answer.seconds
            self._report_progress()
        elif answer.is_mistake and not self._done:
            raise answer.error
        else:
            self._count_failure(frame, answer.error)

    def _replace_worker(self, task: _Task, how: str, error: BaseException | None = None) -> None:
        """Starts a worker in place of a lost one, whose frame counts as a failed try.

        Args:
            task: Task of the lost worker.
            how: Reason for the log.
            error: Error of the frame if all tries fail; None makes one from the reason.
        """
        self.ray.kill(task.worker)
        self._lost += 1
        unit = "frame" if self._frames is None else self._frames.unit
        _log.warning("a worker was lost (%s)%s", how, "" if task.frame is None else f", at {unit} {task.frame}")
        if task.frame is None:
            self._bad_starts += 1
            self._refusal = ls.DeviceError(f"a worker ended before it was ready: {how}")
        else:
            self._count_failure(task.frame, error or ls.DeviceError(f"a worker was lost: {how}"))
        if self._bad_starts < STARTS_IN_A_ROW and not self._is_finished:
            self._start()

    def _end_hung(self) -> None:
        """Ends and replaces each worker whose frame has taken longer than ``--frame-timeout``."""
        if (timeout := self.options.frame_timeout) is None:
            return
        limit = seconds_of("--frame-timeout", timeout)
        for ref, task in list(self._tasks.items()):
            if task.frame is not None and self.clock() - task.since > limit:
                del self._tasks[ref]
                how = f"it takes longer than --frame-timeout {timeout}"
                self._replace_worker(task, f"{how}, and was ended", ls.DeviceError(how))
        self._assign_frames()

    def _count_failure(self, frame: int, error: BaseException) -> None:
        """Puts a failed frame back into the queue, or marks it as failed after `TRIES` tries.

        After `FAILURES_IN_A_ROW` failures, all waiting frames are marked as failed.
        """
        self._failures += 1
        self._tries[frame] = self._tries.get(frame, 0) + 1
        if self._tries[frame] < TRIES:
            self._waiting.append(frame)
        else:
            self._failed[frame] = error
            self._report_progress()
        if self._failures >= FAILURES_IN_A_ROW and self._waiting:
            how = f"given up after {FAILURES_IN_A_ROW} failures in a row, the last: {one_line(error)}"
            self._failed |= dict.fromkeys(self._waiting, ls.DeviceError(how))
            self._waiting.clear()

    def _assign_frames(self) -> None:
        """Gives each idle worker a frame, as long as a frame can start."""
        while self._idle and (frame := self._next_frame()) is not None:
            worker = self._idle.pop(0)
            self._tasks[worker.make.remote(frame)] = _Task(worker, frame, self.clock())

    def _next_frame(self) -> int | None:
        """Takes the first frame from the queue that needs no unfinished frame; None if none can start now.

        A frame that needs a failed frame is marked as failed, too.
        """
        if not self._waiting or self._frames is None or not self._frames.needs:
            return self._waiting.popleft() if self._waiting else None
        undone = {*self._waiting, *(task.frame for task in self._tasks.values())}
        for frame in list(self._waiting):
            needs = self._frames.needs.get(frame, ())
            if failed := [need for need in needs if need in self._failed]:
                self._waiting.remove(frame)
                self._failed[frame] = self._failed[failed[0]]
            elif undone.isdisjoint(needs):
                self._waiting.remove(frame)
                return frame
        return None

    def _report_progress(self) -> None:
        """Reports the number of finished and failed frames, and the mean time of a frame."""
        if self._wanted == 0 or self._frames is None:
            return
        ended = len(self._done) + len(self._failed)
        cost = f", {self._mean_seconds:.3g} s per {self._frames.unit} on one worker" if self._mean_seconds else ""
        failed = f", {len(self._failed)} failed" if self._failed else ""
        self.report(f"{self._frames.unit}s, {ended} of {self._wanted}{cost}{failed}", ended / self._wanted)

    def _log_once(self, line: str) -> None:
        """Logs a warning of a worker, unless a worker has sent the same line before."""
        if line not in self._logged:
            self._logged.add(line)
            _log.warning("%s", line)
