"""Frames as units of work: which there are to be, where, how one is made, and all of them in this process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import lumisplat as ls
from lumisplat.cli.farm.parts import PartFolder
from lumisplat.cli.output.console import FrameProgress, Report, counted, one_line
from lumisplat.cli.output.frame_folder import FrameFolder, check_video, write_video

NAMED_REASONS = 3
"""Reasons why frames failed that a message names, each with its first frame; the others are counted."""


@dataclass(frozen=True, kw_only=True)
class FrameList:
    """The frames of a command."""

    folder: FrameFolder
    """Where they go."""
    provenance: dict[str, str]
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
        self.folder.prepare(self.provenance, overwrite)
        return [index for index in self.wanted if not self.folder.is_finished(index)]

    def count_line(self, overwrite: bool = False) -> str:
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
        messages = [f"{self._frames(indices)}: {reason}" for reason, indices in named]
        rest = len(failed) - sum(len(indices) for _, indices in named)
        messages += [f"and {counted(rest, f'more {self.unit}')}"] if rest else []
        return FramesMissingError(f"{'; '.join(messages)}; {self.count_line(overwrite)}")

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
        folder, provenance = self.frames.folder, self.frames.provenance
        if folder.is_finished(index):
            return None
        try:
            frame = self.render(index, report)
        except ls.FormatError:
            if folder.is_finished(index):  # another process has made it, and removed its parts
                return None
            raise
        folder.check_current(provenance)
        self.write(frame, index)
        try:
            folder.check_current(provenance)
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


def make_frames(job: FrameJob, report: Report, *, overwrite: bool, video: Path | None, fewer: str) -> str:
    """Makes the frames that are missing, then the video.

    Args:
        job: Makes them.
        report: Shows the progress.
        overwrite: Whether to make those that are there anew.
        video: A video of them; None: none.
        fewer: The options that make frames fewer, as they are typed.

    Returns:
        What there is now, in lines.

    Raises:
        KeyboardInterrupt: It was interrupted; says how many frames there are.
        FramesMissingError: A frame could not be made.
        LumisplatError: Something is wrong with the settings or the scene.
    """
    frames = job.frames
    if video is not None:
        check_video(video, frames.fps or 0.0)
    missing = frames.begin(overwrite)
    try:
        _make(job, missing, report, overwrite=overwrite, fewer=fewer)
        return finish_frames(frames, len(missing), video, report)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(frames.count_line(overwrite)) from None


def _make(job: FrameJob, missing: list[int], report: Report, *, overwrite: bool, fewer: str) -> None:
    """Makes frames; an error in one of them ends it."""
    if not missing:
        return
    unit = job.frames.unit
    progress = FrameProgress(report, f"{unit}s", len(missing), fewer if unit == "frame" else "", unit)
    made = 0
    frame: ls.Frame | ls.farm.SamplePart | None = None
    for index in missing:
        try:
            frame = job.make(index, report)
        except (ls.LumisplatError, OSError, MemoryError) as error:
            if isinstance(error, ls.ConfigError) or (made == 0 and is_mistake(error, job.frames)):
                raise
            raise job.frames.missing_error({index: error}, overwrite) from error
        made += frame is not None
        progress.add(frame)
    if frame is not None and job.summarise is not None:
        job.summarise(frame, made)


def finish_frames(frames: FrameList, made: int, video: Path | None, report: Report) -> str:
    """Joins parts, or writes the video of all frames, if there is to be one; what there is now, in lines.

    Args:
        frames: All of them are there.
        made: Number of those that were missing.
        video: The file of the video; None: none.
        report: Shows the progress.

    Raises:
        FormatError: The video or a picture of parts cannot be written.
    """
    if isinstance(folder := frames.folder, PartFolder):
        joined = folder.join(report)
        return f"{joined[0]}" if len(joined) == 1 else f"{len(joined)} pictures in {folder.folder}"
    reused = len(frames.wanted) - made
    were = "was" if reused == 1 else "were"
    lines = f"{counted(len(frames.wanted), frames.unit)} in {frames.folder.folder}"
    lines += f", {reused} of them {were} there" * bool(reused)
    if video is None or frames.fps is None:
        return lines
    write_video(video, [frames.folder.path(index) for index in frames.wanted], frames.fps, report)
    return f"{lines}\n{video} ({frames.fps:g} frames a second, {len(frames.wanted) / frames.fps:.2f} s)"
