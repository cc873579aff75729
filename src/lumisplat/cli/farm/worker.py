"""A worker of a farm: loads the scene once, and makes the frames that it is given."""

from __future__ import annotations

import logging
import os
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.executor import Done, Event, Failed, Ready, Refused
from lumisplat.cli.farm.job import FrameJob, FrameMaker, is_mistake
from lumisplat.cli.output.console import Report


@dataclass(frozen=True)
class Order:
    """What workers are to do."""

    command: FrameMaker
    """Whose frames they make."""
    folder: str
    """Where relative paths begin."""
    debug: bool = False
    """Whether they print their errors with tracebacks."""


class Worker:
    """Makes frames of a command.

    Args:
        number: The worker's.
        order: What it is to do.
        environment: Variables of the process, set before anything is loaded.
    """

    def __init__(self, number: int, order: Order, environment: dict[str, str]) -> None:
        os.environ.update(environment)
        self._number, self._order = number, order
        self._job: FrameJob | None = None
        self._made = 0
        self.lines: list[str] = []
        """Remarks for the user, to be taken away."""
        log = logging.getLogger("lumisplat")
        log.addHandler(_Collected(self.lines))
        log.propagate = False

    def open(self, report: Report) -> Event:
        """Loads the scene."""
        try:
            if not Path(self._order.folder).is_dir():
                raise ls.FormatError(
                    self._order.folder,
                    "is no folder where a worker runs: the scene and the frames lie where all see them",
                )
            os.chdir(self._order.folder)
            self._job = self._order.command.open_frames(report)
        except (ls.LumisplatError, OSError, MemoryError) as error:
            return Refused(self._number, self._told(error))
        except Exception as error:  # a mistake of ours
            return Refused(self._number, self._told(_ours(error)))
        return Ready(self._number, self._job.frames)

    def make(self, frame: int) -> Event:
        """Makes a frame."""
        assert self._job is not None
        begun = time.perf_counter()
        try:
            made = self._job.make(frame, _nothing)
        except (ls.LumisplatError, OSError, MemoryError) as error:
            wrong = isinstance(error, ls.ConfigError) or (self._made == 0 and is_mistake(error, self._job.frames))
            return Failed(self._number, frame, self._told(error), wrong)
        except Exception as error:  # a mistake of ours: the worker goes on
            return Failed(self._number, frame, self._told(_ours(error)), False)
        self._made += 1
        return Done(self._number, frame, 0.0 if made is None else time.perf_counter() - begun)

    def _told(self, error: BaseException) -> BaseException:
        """An error, printed if all of it is wanted."""
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


def _ours(error: Exception) -> ls.LumisplatError:
    """What to say of an error that is no mistake of the user: it crosses to the driver, whatever it holds."""
    at = traceback.extract_tb(error.__traceback__)[-1]
    said = ls.LumisplatError(f"{type(error).__name__}: {error}, in {at.filename}, line {at.lineno}")
    said.__cause__ = error
    return said


def _nothing(label: str, fraction: float) -> None:
    """Shows no progress: that of single frames is not the driver's."""
