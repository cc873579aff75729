"""Frames as units of work: which there are to be, where, what they are made of, and how one is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted, one_line
from lumisplat.cli.output.frame_folder import FrameFolder

NAMED_REASONS = 3
"""Reasons why frames failed that a message names, each with its first frame; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class FrameList:
    """The frames of a command."""

    folder: FrameFolder
    """Where they go."""
    origin: dict[str, str]
    """All that they are made of, by name."""
    wanted: tuple[int, ...]
    """Their numbers."""
    fps: float | None = None
    """Frames a second, if they are those of a film."""
    in_sequence: bool = False
    """Whether a frame follows from those before it."""
    needs: Mapping[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])
    """Frames that others are made of, which come after them."""
    unit: str = "frame"
    """What one of them is called."""
    go_on: str = "without --overwrite"
    """How a command that has begun anew is changed to go on."""

    def begin(self, overwrite: bool) -> list[int]:
        """Makes the folder ready; the frames that are missing.

        Raises:
            ConfigError: There are frames of another origin.
            FormatError: The folder cannot be written to.
        """
        self.folder.prepare(self.origin, overwrite)
        return [index for index in self.wanted if not self.folder.is_finished(index)]

    def there(self, overwrite: bool = False) -> str:
        """How many of the frames are there, and how to go on."""
        count = sum(map(self.folder.is_finished, self.wanted))
        again = f"the same command {self.go_on}" if overwrite else "the same command"
        return f"{self.folder.folder} holds {count} of {counted(len(self.wanted), self.unit)}; {again} continues"

    def missing_error(self, failed: Mapping[int, BaseException], overwrite: bool) -> ls.LumisplatError:
        """A `FramesMissingError` that says which frames failed, why, and how to go on."""
        from lumisplat.cli.farm.failed_frames import FramesMissingError

        reasons: dict[str, list[int]] = {}
        for index in sorted(failed):
            reasons.setdefault(one_line(failed[index]), []).append(index)
        named = list(reasons.items())[:NAMED_REASONS]
        told = [f"{self._frames(indices)}: {reason}" for reason, indices in named]
        rest = len(failed) - sum(len(indices) for _, indices in named)
        told += [f"and {counted(rest, f'more {self.unit}')}"] if rest else []
        return FramesMissingError(f"{'; '.join(told)}; {self.there(overwrite)}")

    def _frames(self, indices: list[int]) -> str:
        others = f" and {counted(len(indices) - 1, f'more {self.unit}')}" if len(indices) > 1 else ""
        return f"{self.unit} {indices[0]}{others}"


@dataclass(frozen=True, kw_only=True)
class FrameJob:
    """The frames of a command, ready to be made: what can be checked is checked, and the scene is loaded."""

    frames: FrameList
    render: Callable[[int, Report], Any]
    """Renders one of them: a `lumisplat.Frame`, or a part of one."""
    write: Callable[[Any, int], None]
    """Writes it."""
    summarise: Callable[[Any, int], None] | None = None
    """Prints what so many frames took, of which the given one is the last."""

    def make(self, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart | None:
        """Renders a frame and writes it whole, unless it is there.

        Returns:
            The frame; None: it was there, for another process has made it.

        Raises:
            ConfigError: Another run with other settings has begun in the folder.
            LumisplatError: As of ``render`` and ``write``.
            OSError: Likewise.
        """
        folder, origin = self.frames.folder, self.frames.origin
        if folder.is_finished(index):
            return None
        try:
            frame = self.render(index, report)
        except ls.FormatError:
            if folder.is_finished(index):  # another process has made it, and removed its parts
                return None
            raise
        folder.check_current(origin)
        self.write(frame, index)
        try:
            folder.check_current(origin)
        except ls.ConfigError:
            with suppress(OSError):
                folder.path(index).unlink()
            raise
        folder.tidy(index)
        return frame


class FrameMaker(Protocol):
    """A command whose result are frames."""

    def open_frames(self, report: Report) -> FrameJob:
        """Checks all that can be checked, and loads the scene."""
        ...


def is_mistake(error: BaseException, frames: FrameList) -> bool:
    """Whether an error of the first frame that is made will come of all: a setting, a file or a package."""
    if isinstance(error, ls.FormatError):
        return not frames.folder.holds(error.path)
    return isinstance(error, ls.ConfigError | ls.SceneError | ls.errors.MissingExtraError)
