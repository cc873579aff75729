"""A worker of a farm, an actor of Ray: it loads the scene once, and makes the frames that it is given."""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, FrameMaker, is_mistake

THREADS_VARIABLE = "LUMISPLAT_THREADS"
"""How many CPU threads a process may use."""


@dataclass(frozen=True)
class Order:
    """What workers are to do."""

    command: FrameMaker
    """Whose frames they make."""
    folder: str
    """Where relative paths begin."""
    debug: bool = False
    """Whether they print their errors with tracebacks."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """What a worker says when it has loaded the scene, or made a frame."""

    lines: list[str]
    """Its remarks."""
    host: str
    """The name of its machine."""
    frames: FrameList | None = None
    """The frames as it sees them, once it has loaded the scene."""
    error: BaseException | None = None
    """Why it could not do it."""
    is_mistake: bool = False
    """Whether the same is wrong of all frames."""
    seconds: float = 0.0
    """What the frame took; 0: it was there."""


class Worker:
    """Makes frames of a command.

    Args:
        order: What it is to do.
        threads: CPU threads that it may use, which is set before anything is loaded.
    """

    def __init__(self, order: Order, threads: int) -> None:
        os.environ[THREADS_VARIABLE] = f"{threads}"
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the driver's, which ends its workers
        self._order = order
        self._job: FrameJob | None = None
        self._made = 0
        self._lines: list[str] = []
        log = logging.getLogger("lumisplat")
        log.addHandler(_Collected(self._lines))
        log.propagate = False

    def open(self) -> Answer:
        """Loads the scene."""
        try:
            if not Path(self._order.folder).is_dir():
                what = "is no folder where a worker runs: the scene and the frames lie where all see them"
                raise ls.FormatError(self._order.folder, what)
            os.chdir(self._order.folder)
            self._job = self._order.command.open_frames(_no_progress)
        except Exception as error:
            return self._answer(error=self._portable_error(error))
        return self._answer(frames=self._job.frames)

    def make(self, frame: int) -> Answer:
        """Makes a frame."""
        assert self._job is not None
        begun = time.perf_counter()
        try:
            made = self._job.make(frame, _no_progress)
        except Exception as error:
            wrong = isinstance(error, ls.ConfigError) or (self._made == 0 and is_mistake(error, self._job.frames))
            return self._answer(error=self._portable_error(error), is_mistake=wrong)
        self._made += 1
        return self._answer(seconds=0.0 if made is None else time.perf_counter() - begun)

    def _answer(
        self,
        *,
        frames: FrameList | None = None,
        error: BaseException | None = None,
        is_mistake: bool = False,
        seconds: float = 0.0,
    ) -> Answer:
        lines, self._lines[:] = list(self._lines), []
        host = socket.gethostname()
        return Answer(lines=lines, host=host, frames=frames, error=error, is_mistake=is_mistake, seconds=seconds)

    def _portable_error(self, error: Exception) -> BaseException:
        """Returns an error as one that crosses to the driver, and prints it if all of it is wanted."""
        if not isinstance(error, ls.LumisplatError | OSError | MemoryError):  # a mistake of ours
            at = traceback.extract_tb(error.__traceback__)[-1]
            described = ls.LumisplatError(f"{type(error).__name__}: {error}, in {at.filename}, line {at.lineno}")
            described.__cause__, error = error, described
        if self._order.debug:
            traceback.print_exception(error)
        return error


class _Collected(logging.Handler):
    """Keeps what is logged for the driver, which says it once for all workers."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Keeps a line."""
        self._lines.append(record.getMessage())


def _no_progress(label: str, fraction: float) -> None:
    """Shows no progress: that of single frames is not the driver's."""
