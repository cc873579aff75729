"""The frames of a command as a job: which are wanted, where they are written, and functions that make them."""

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
"""Largest number of different errors that the message about failed frames quotes."""


@dataclass(frozen=True, kw_only=True)
class FrameList:
    """The frames that a command has to make: their folder, their numbers, and what they depend on."""

    folder: FrameFolder
    """Folder into which the frames are written."""
    provenance: dict[str, str]
    """All settings and file fingerprints that the frames depend on, as text by name."""
    wanted: tuple[int, ...]
    """Numbers of the frames to make."""
    fps: float | None = None
    """Frames per second of the animation; None if the frames are single images."""
    in_sequence: bool = False
    """True if a frame depends on the one before, as in the realtime pipeline, so that workers cannot share frames."""
    needs: Mapping[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])
    """For each frame that is merged from others, such as sample blocks: the numbers of the frames that must exist
    first."""
    unit: str = "frame"
    """Word for a frame in messages, such as ``view``."""
    resume_hint: str = "without --overwrite"
    """How a command line with --overwrite must be changed so that it continues an interrupted run; part of messages."""

    def begin(self, overwrite: bool) -> list[int]:
        """Creates the folder and its stamp, and returns the numbers of the frames that do not exist yet.

        Raises:
            ConfigError: The folder has frames of another provenance.
            FormatError: The folder cannot be written.
        """
        self.folder.prepare(self.provenance, overwrite)
        return [index for index in self.wanted if not self.folder.is_finished(index)]

    def count_line(self, overwrite: bool = False) -> str:
        """Returns a text that says how many frames exist, and how to run the command again to continue.

        Args:
            overwrite: True if the command was told to overwrite; it must be told to resume instead.
        """
        count = sum(map(self.folder.is_finished, self.wanted))
        again = f"the same command {self.resume_hint}" if overwrite else "the same command"
        return f"{self.folder.folder} holds {count} of {counted(len(self.wanted), self.unit)}; {again} continues"

    def missing_error(self, failed: Mapping[int, BaseException], overwrite: bool) -> ls.LumisplatError:
        """Returns the error about failed frames, with their reasons and how to continue.

        Args:
            failed: Error of each failed frame, by frame number.
            overwrite: True if the command was told to overwrite existing frames.
        """
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
    """Frames of a command, with functions that render and write them; options are checked, the scene is loaded."""

    frames: FrameList
    render: Callable[[int, Report], Any]
    """Renders the frame of a number. Returns a `lumisplat.Frame`, or what `write` accepts instead, such as a block of
    samples."""
    write: Callable[[Any, int], None]
    """Writes what `render` has returned to the file of the frame number."""
    summarise: Callable[[Any, int], None] | None = None
    """Prints statistics, given the last frame and the number of frames that were made; None prints nothing."""

    def make(self, index: int, report: Report) -> ls.Frame | ls.farm.SamplePart | None:
        """Renders and writes the frame of a number, unless its file exists.

        Returns:
            The result of `render`; None if the file already exists, as another process may have written it.

        Raises:
            ConfigError: Another run with other settings has started in the folder.
            LumisplatError: Raised by ``render`` or ``write``.
            OSError: Raised by ``render`` or ``write``.
        """
        folder, provenance = self.frames.folder, self.frames.provenance
        if folder.is_finished(index):
            return None
        try:
            frame = self.render(index, report)
        except ls.FormatError:
            if folder.is_finished(index):  # another process has made the frame and removed its parts
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
    """Interface of a command that makes frames, one by one."""

    def open_frames(self, report: Report) -> FrameJob:
        """Checks options and files, loads the scene, and returns the frames with functions that make them."""
        ...


def is_mistake(error: BaseException, frames: FrameList) -> bool:
    """True if a frame's error would recur in all frames: a wrong setting, missing package or unreadable input file.

    Errors of files in the folder of the frames do not count.
    """
    if isinstance(error, ls.FormatError):
        return not frames.folder.holds(error.path)
    return isinstance(error, ls.ConfigError | ls.SceneError | ls.errors.MissingExtraError)


def make_frames(job: FrameJob, report: Report, *, overwrite: bool, video: Path | None, fewer: str) -> str:
    """Makes the missing frames of a command in this process, then the video.

    Args:
        job: Frames to make, with the functions that render and write them.
        report: Receives the progress.
        overwrite: True deletes existing frames first.
        video: Path of the video; None writes no video.
        fewer: Options that reduce the number of frames, as typed, for an advice in the log.

    Returns:
        Summary lines about the frames.

    Raises:
        KeyboardInterrupt: The command was interrupted; the message counts the existing frames.
        FramesMissingError: A frame failed.
        LumisplatError: A setting or the scene is wrong.
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
    """Makes the missing frames in order of their numbers; an error ends the run.

    Args:
        job: Frames to make.
        missing: Numbers of the missing frames.
        report: Receives the progress.
        overwrite: True if the command was told to overwrite existing frames, for messages.
        fewer: Options that reduce the number of frames, as typed, for an advice in the log.

    Raises:
        FramesMissingError: A frame failed.
        LumisplatError: A setting or the scene is wrong, which the first frame shows.
    """
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
    """Completes a command whose frames all exist: joins image parts, or writes the video. Returns summary lines.

    Args:
        frames: The frames, all of which exist.
        made: Number of frames that this run has made.
        video: Path of the video; None writes no video.
        report: Receives the progress.

    Raises:
        FormatError: The video or a joined image cannot be written.
    """
    if isinstance(folder := frames.folder, PartFolder):
        joined = folder.join(report)
        return f"{joined[0]}" if len(joined) == 1 else f"{len(joined)} images in {folder.folder}"
    reused = len(frames.wanted) - made
    lines = f"{counted(len(frames.wanted), frames.unit)} in {frames.folder.folder}"
    lines += f", {reused} of them already existed" * bool(reused)
    if video is None or frames.fps is None:
        return lines
    write_video(video, [frames.folder.path(index) for index in frames.wanted], frames.fps, report)
    return f"{lines}\n{video} ({frames.fps:g} frames a second, {len(frames.wanted) / frames.fps:.2f} s)"
