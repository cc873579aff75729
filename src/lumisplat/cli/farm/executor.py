"""What a farm's driver and its workers tell each other, wherever the workers run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from lumisplat.cli.farm.job import FrameList


@dataclass(frozen=True)
class Ready:
    """A worker has loaded the scene."""

    worker: int
    frames: FrameList
    """The frames as this worker sees them."""


@dataclass(frozen=True)
class Refused:
    """A worker cannot work: an option or a file is wrong, or there is no memory."""

    worker: int
    error: BaseException


@dataclass(frozen=True)
class Done:
    """A frame is there."""

    worker: int
    frame: int
    seconds: float
    """What it took of the worker, seconds; 0: it was there."""


@dataclass(frozen=True)
class Failed:
    """A frame could not be made; its worker goes on."""

    worker: int
    frame: int
    error: BaseException
    is_mistake: bool
    """Whether the same is wrong of all frames."""


@dataclass(frozen=True)
class Lost:
    """A worker is gone, with what it had in hand."""

    worker: int
    how: str
    """What is known of its end, such as ``killed by SIGKILL``."""


@dataclass(frozen=True)
class Said:
    """A worker has a remark for the user."""

    worker: int
    line: str


@dataclass(frozen=True)
class Reported:
    """How far a worker is that loads its scene."""

    worker: int
    label: str
    fraction: float


Event = Ready | Refused | Done | Failed | Lost | Said | Reported


class Executor(Protocol):
    """Runs workers. A worker makes the frames that it is given one after the other, in their order."""

    def start(self) -> int:
        """Starts another worker; its number, which none had before."""
        ...

    def submit(self, worker: int, frame: int) -> None:
        """Gives a worker a frame; if it is gone, nothing happens, and `Lost` says so."""
        ...

    def stop(self, worker: int) -> None:
        """Ends a worker; nothing more is heard of it."""
        ...

    def events(self, timeout: float) -> Sequence[Event]:
        """What has happened since the last call, in order; waits for something for so many seconds."""
        ...

    def close(self) -> None:
        """Ends all workers."""
        ...
