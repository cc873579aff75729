"""Frames one after the other, in this process."""

from __future__ import annotations

from pathlib import Path

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, is_mistake
from lumisplat.cli.farm.parts import PartFolder
from lumisplat.cli.output.console import FrameProgress, Report, counted
from lumisplat.cli.output.video import check_video, write_video


def make_alone(job: FrameJob, report: Report, *, overwrite: bool, video: Path | None, fewer: str) -> str:
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
        return film_lines(frames, len(missing), video, report)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(frames.there(overwrite)) from None


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


def film_lines(frames: FrameList, made: int, video: Path | None, report: Report) -> str:
    """Joins parts, or writes the video of all frames, if there is to be one; what there is now, in lines.

    Args:
        frames: All of them are there.
        made: Number of those that were missing.
        video: The file of the video; None: none.
        report: Shows the progress.

    Raises:
        FormatError: The video or a picture of parts cannot be written.
    """
    if isinstance(frames.folder, PartFolder):
        return _join(frames.folder, report)
    there = len(frames.wanted) - made
    were = "was" if there == 1 else "were"
    lines = f"{counted(len(frames.wanted), frames.unit)} in {frames.folder.folder}"
    lines += f", {there} of them {were} there" * bool(there)
    if video is None or frames.fps is None:
        return lines
    write_video(video, [frames.folder.path(index) for index in frames.wanted], frames.fps, report)
    return f"{lines}\n{video} ({frames.fps:g} frames a second, {len(frames.wanted) / frames.fps:.2f} s)"


def _join(folder: PartFolder, report: Report) -> str:
    """Joins the parts of pictures; what there is now, in a line."""
    there = folder.join(report)
    return f"{there[0]}" if len(there) == 1 else f"{len(there)} pictures in {folder.folder}"
