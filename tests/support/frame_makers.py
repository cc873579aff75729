"""Provides farm jobs that make frames without a renderer, and that fail in prescribed ways."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList
from lumisplat.cli.output.console import Report
from lumisplat.cli.output.frame_folder import FrameFolder


@dataclass(frozen=True)
class FakeMaker:
    """Writes frames as files that contain their numbers; ``folder/made`` gets a file each time a frame is begun.

    A prescribed failure happens only the first time, unless ``again`` is set.
    """

    folder: Path
    count: int = 8
    seconds: float = 0.0
    """Seconds that each frame takes."""
    wrong: dict[int, str] = field(default_factory=dict[int, str])
    """Failure of each listed frame: ``exit``, ``kill``, ``hang``, ``full`` (disk full), ``setting`` (ConfigError),
    ``data`` (SceneError), ``extra`` (missing package), ``bug`` (ValueError)."""
    again: bool = False
    needs: Path | None = None
    """File that must exist for a worker to start."""
    in_sequence: bool = False
    kind: str = "fake"
    """Text stored as ``kind`` in the provenance of the frames, so that jobs with other texts have other settings."""

    def open_frames(self, report: Report) -> FrameJob:
        """Returns the job with all frames."""
        report("loading", 1.0)
        if self.needs is not None and not self.needs.exists():
            raise ls.errors.MissingFileError(self.needs, "no such file")
        frames = FrameList(
            folder=FrameFolder(self.folder, "png", "fake.json"),
            provenance={"kind": self.kind, "needs": str(self.needs.stat().st_size) if self.needs else ""},
            wanted=tuple(range(self.count)),
            in_sequence=self.in_sequence,
        )
        return FrameJob(frames=frames, render=self._render, write=self._write)

    @property
    def begun(self) -> list[int]:
        """Numbers of the frames that were begun, sorted, each as often as it was begun."""
        return sorted(int(path.name.split("_")[0]) for path in self._log.iterdir())

    @property
    def contents(self) -> dict[str, str]:
        """Contents of the finished frames by file name."""
        return {path.name: path.read_text() for path in sorted(self.folder.glob("frame_*.png"))}

    @property
    def _log(self) -> Path:
        return self.folder.parent / "made"

    def _render(self, index: int, report: Report) -> ls.Frame:
        self._log.mkdir(exist_ok=True)
        (self._log / f"{index}_{os.getpid()}_{time.monotonic_ns()}").touch()
        time.sleep(self.seconds)
        if index in self.wrong and (self.again or self._first_time(index)):
            _WRONG[self.wrong[index]](self.folder / f"frame_{index:04d}.png")
        return cast(ls.Frame, SimpleNamespace(samples=1))

    def _write(self, frame: ls.Frame, index: int) -> None:
        temporary = self.folder / f".{index}.{os.getpid()}"
        temporary.write_text(f"{index}")
        os.replace(temporary, self.folder / f"frame_{index:04d}.png")

    def _first_time(self, index: int) -> bool:
        try:
            (self.folder.parent / f"wrong_{index}").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True


def _kill(_: Path) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _raise(error: Callable[[Path], Exception]) -> Callable[[Path], None]:
    def fail(path: Path) -> None:
        raise error(path)

    return fail


_WRONG: dict[str, Callable[[Path], Any]] = {
    "exit": lambda _: os._exit(7),
    "kill": _kill,
    "hang": lambda _: time.sleep(1000.0),
    "bug": _raise(lambda _: ValueError("shapes differ")),
    "full": _raise(lambda path: ls.FormatError(path, "cannot be written: No space left on device")),
    "setting": _raise(lambda _: ls.ConfigError("samples is 0, expected 1 or more")),
    "extra": _raise(lambda _: ls.errors.MissingExtraError("OpenUSD", "usd")),
    "data": _raise(lambda _: ls.SceneError("walk/0003.ply: ends in the middle of Gaussian 5")),
}
