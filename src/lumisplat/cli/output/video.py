"""The video of an animation, made of the pictures of its frames."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.output.console import Report

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def check_video(path: Path, fps: float) -> None:
    """Tries whether a video can be written, before an hour of frames: extension, rate, package and folder.

    Raises:
        FormatError: It cannot be written.
        MissingExtraError: A package is not installed.
    """
    if path.suffix.lower() == ".png":
        raise ls.FormatError(path, "is a picture's name, expected .mp4, .gif, .webp or .apng")
    import numpy as np

    if path.exists() and not path.is_file():
        raise ls.FormatError(path, "is a folder or a device, expected the name of a video")
    with tempfile.TemporaryDirectory() as elsewhere:
        trial = Path(elsewhere) / f"trial{path.suffix}"
        try:
            ls.save_animation(trial, [np.zeros((16, 16, 3), np.float32)], fps)
        except ls.FormatError as error:
            raise ls.FormatError(path, str(error).removeprefix(f"{trial}: ")) from None
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise ls.FormatError(path, f"cannot be written, nothing can in {folder}: {error.strerror}") from None


def write_video(path: Path, frames: Sequence[Path], fps: float, report: Report) -> None:
    """Writes a video of pictures.

    Raises:
        FormatError: It cannot be written.
        SceneError: A picture cannot be read.
    """
    ls.save_animation(path, _pictures(frames, report), fps)


def _pictures(paths: Sequence[Path], report: Report) -> Iterator[npt.NDArray[np.float32]]:
    """Pictures one by one."""
    for done, path in enumerate(paths):
        report("writing the video", done / len(paths))
        try:
            yield ls.load_image(path)
        except ls.FormatError as error:
            raise ls.SceneError(f"{error}; delete it and run the command again, which makes it anew") from None
    report("writing the video", 1.0)
