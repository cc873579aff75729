"""Worker process of ``lumisplat farm``: a Ray actor that loads the scene once and then makes frames."""

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
"""Environment variable that limits the number of CPU threads of a process."""


@dataclass(frozen=True)
class Order:
    """Message from the driver to each new worker: the command, the working folder and options."""

    command: FrameMaker
    """Command whose frames the worker makes."""
    folder: str
    """Working folder of the driver; relative paths in the command refer to it."""
    debug: bool = False
    """True if workers print their errors with tracebacks."""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """Result of a worker's call: the scene was loaded, or a frame was made or failed."""

    lines: list[str]
    """Warnings that the worker has logged since its last result."""
    host: str
    """Host name of the machine on which the worker runs."""
    frames: FrameList | None = None
    """Frames of the command if the call loaded the scene; None if it failed or made a frame."""
    error: BaseException | None = None
    """Error of the call; None if it succeeded."""
    is_mistake: bool = False
    """True if the error would recur in all frames, such as a wrong setting."""
    seconds: float = 0.0
    """Time that the frame took, seconds; 0 if it already existed."""


class Worker:
    """Ray actor that makes frames of a command.

    Args:
        order: Command and settings.
        threads: Number of CPU threads, which is set before anything is loaded.
    """

    def __init__(self, order: Order, threads: int) -> None:
        os.environ[THREADS_VARIABLE] = f"{threads}"
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver handles Ctrl-C and ends its workers
        self._order = order
        self._job: FrameJob | None = None
        self._made = 0
        self._lines: list[str] = []
        log = logging.getLogger("lumisplat")
        log.addHandler(_Collected(self._lines))
        log.propagate = False

    def open(self) -> Answer:
        """Loads the scene of the command; returns the command's frames or the error."""
        try:
            if not Path(self._order.folder).is_dir():
                what = "is no folder on a worker's machine: scene and frames need a folder that all machines see"
                raise ls.FormatError(self._order.folder, what)
            os.chdir(self._order.folder)
            self._job = self._order.command.open_frames(_no_progress)
        except Exception as error:
            return self._answer(error=self._portable_error(error))
        return self._answer(frames=self._job.frames)

    def make(self, frame: int) -> Answer:
        """Makes the frame of a number; returns its time or the error."""
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
        """Converts an error to one that can be pickled for the driver; with ``--debug``, also prints its traceback."""
        if not isinstance(error, ls.LumisplatError | OSError | MemoryError):  # a bug of this package
            at = traceback.extract_tb(error.__traceback__)[-1]
            described = ls.LumisplatError(f"{type(error).__name__}: {error}, in {at.filename}, line {at.lineno}")
            described.__cause__, error = error, described
        if self._order.debug:
            traceback.print_exception(error)
        return error


class _Collected(logging.Handler):
    """Log handler that collects a worker's warnings, to be sent to the driver with the next result."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__(logging.WARNING)
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Appends the text of a log record to the collected warnings."""
        self._lines.append(record.getMessage())


def _no_progress(label: str, fraction: float) -> None:
    """Progress function that does nothing: the driver counts frames only."""
