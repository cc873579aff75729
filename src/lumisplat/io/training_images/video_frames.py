"""Extracts the sharpest frame of each time interval of a video as training images, with PyAV."""

from __future__ import annotations

import logging
import math
import os
import tempfile
from collections.abc import Generator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lumisplat.config.checks import check_positive, check_whole
from lumisplat.errors import FormatError, MissingExtraError, MissingFileError
from lumisplat.io.files.source import PathLike
from lumisplat.progress import Progress

_log = logging.getLogger("lumisplat")

_JPEG_QUALITY = 95
_COMPARED_SIZE = 480
"""Longer image side, in pixels, at which sharpness is measured. At full size, noise of single pixels would count as
detail."""
_HDR_TRANSFERS = {16: "PQ", 18: "HLG"}
"""Names of HDR transfer functions by their code in ITU-T H.273. Frames of such videos are not display-referred sRGB."""
_ROTATIONS = (None, Image.Transpose.ROTATE_90, Image.Transpose.ROTATE_180, Image.Transpose.ROTATE_270)
"""Pillow operations by the number of 90 degree rotations to the left."""

_STILL_SIZE = 16
"""Longer side, in pixels, to which frames are reduced before motion is detected; averaging removes noise."""
_STILL_DIFFERENCE = 0.5
"""Mean difference from the first frame, in grey values 0..255, that a video must reach once to count as moving."""
_BLACK_LEVEL = 16
"""Largest grey value, 0..255, of a black frame: 16, the black of video, plus noise."""


def extract_frames(
    video: PathLike, folder: PathLike, *, every: float = 0.5, size: int = 1600, progress: Progress | None = None
) -> list[Path]:
    """Extracts training images from a video: the sharpest frame of each time interval, rotated upright.

    Images are written to the subfolder ``images``, as `find_poses` and COLMAP expect. If anything fails, no image is
    written.

    Args:
        video: A file that FFmpeg reads: .mp4, .mov, .webm, ...
        folder: Output folder, created if needed; it must not contain ``images``.
        every: Length of an interval, seconds. Neighbouring images should overlap by two thirds.
        size: Longer side of the images, pixels; larger frames are downscaled.
        progress: Called with the name of the current step and the fraction done, 0..1.

    Returns:
        The image files, ``0001.jpg`` and so on, in temporal order.

    Raises:
        ConfigError: ``every`` or ``size`` is out of range.
        FormatError: The video cannot be read, is black throughout or shows no motion, or ``images`` already exists.
        MissingExtraError: PyAV is not installed.
        MissingFileError: There is no such file.
    """
    video, images = Path(video), Path(folder) / "images"
    check_positive("every", every)
    check_whole("size", size, 16, 2**15)
    if not video.is_file():
        raise MissingFileError(video, "no such file")
    if images.exists():
        raise FormatError(images, "already exists: remove it, or give another folder")
    try:
        av: Any = import_module("av")  # most of its types are unknown
    except ImportError:
        raise MissingExtraError("reading videos", "video") from None
    try:
        images.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".frames-", dir=images.parent) as temporary:
            made = Path(temporary) / "images"
            made.mkdir()
            check = _FrameCheck()
            names: list[str] = []
            for image in _sharpest_frames(av, video, every, progress):
                check.add(image)
                names.append(_save(image, made / f"{len(names) + 1:04}.jpg", size))
            if problem := check.problem():
                raise FormatError(video, problem)
            os.replace(made, images)
    except av.error.FFmpegError as error:
        raise FormatError(video, f"is not a readable video: {error.strerror or error}") from None
    except OSError as error:
        raise FormatError(images, f"cannot be written: {error.strerror or error}") from None
    return [images / name for name in names]


@dataclass(frozen=True, slots=True)
class _Candidate:
    """Sharpest frame so far of the current time interval."""

    sharpness: float
    image: Image.Image


def _sharpest_frames(av: Any, video: Path, every: float, progress: Progress | None) -> Generator[Image.Image]:
    """Yields the sharpest frame of each time interval, rotated upright; an interval without frames is skipped."""
    with av.open(str(video)) as container:
        if not container.streams.video:
            raise FormatError(video, "has no video stream")
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        length = (container.duration or 0) / av.time_base
        best: _Candidate | None = None
        interval = 0
        for frame in container.decode(stream):
            if frame.is_corrupt:
                continue
            time = frame.time or 0.0
            if best is None:
                _warn_if_hdr(video, frame)
            elif int(time / every) > interval:
                yield best.image
                best = None
            interval = int(time / every)
            image = _upright(frame)
            found = sharpness(image)
            if best is None or found > best.sharpness:
                best = _Candidate(found, image)
            if progress is not None and length > 0.0:
                progress("reading the video", min(time / length, 1.0))
        if best is not None:
            yield best.image


class _FrameCheck:
    """Detects videos that are black or show no motion, from small grey versions of the extracted frames."""

    def __init__(self) -> None:
        self._first: NDArray[np.float32] | None = None
        self._count = 0
        self._brightest = 0.0
        self._moved = 0.0

    def add(self, image: Image.Image) -> None:
        """Compares the next extracted frame with the first one, and updates the largest motion and brightness."""
        small = image.convert("L")
        small.thumbnail((_STILL_SIZE, _STILL_SIZE), Image.Resampling.BOX)
        grey = np.asarray(small, np.float32)
        if self._first is None:
            self._first = grey
        elif grey.shape == self._first.shape:
            self._moved = max(self._moved, float(np.abs(grey - self._first).mean()))
        self._count += 1
        self._brightest = max(self._brightest, float(grey.max()))

    def problem(self) -> str | None:
        """Describes why the video is unusable, or returns None if it is usable."""
        if self._count == 0:
            return "has no frames"
        if self._brightest <= _BLACK_LEVEL:
            return "is black throughout: was the lens covered?"
        if self._count > 1 and self._moved < _STILL_DIFFERENCE:
            return "shows no motion: expected a walk around an object, because depth needs several viewpoints"
        return None


def sharpness(image: Image.Image) -> float:
    """Returns the sharpness of an image: the variance of the Laplacian of its grey values at `_COMPARED_SIZE`.

    See Pech-Pacheco et al. 2000.
    """
    small = image.convert("L")
    small.thumbnail((_COMPARED_SIZE, _COMPARED_SIZE), Image.Resampling.BOX)
    grey = np.asarray(small, np.float32)
    center = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4.0 * center
    return float(laplacian.var()) if laplacian.size else 0.0


def _upright(frame: Any) -> Image.Image:
    """Converts a video frame to an image, rotated as its metadata says; phones store portrait videos rotated."""
    image = Image.fromarray(frame.to_ndarray(format="rgb24"))
    rotation = _ROTATIONS[round(float(frame.rotation) / 90.0) % 4]
    return image if rotation is None else image.transpose(rotation)


def _warn_if_hdr(video: Path, frame: Any) -> None:
    kind = _HDR_TRANSFERS.get(int(frame.color_trc))
    if kind is not None:
        _log.warning("%s: is HDR (%s), so its images will look pale: record with HDR switched off", video, kind)


def _save(image: Image.Image, path: Path, size: int) -> str:
    """Writes an image as JPEG, downscaled to a longer side of at most ``size`` pixels. Returns the file name."""
    shrink = min(size / max(image.size), 1.0)
    if shrink < 1.0:
        width, height = (max(math.floor(side * shrink + 0.5), 1) for side in image.size)
        image = image.resize((width, height), Image.Resampling.LANCZOS)
    image.save(path, quality=_JPEG_QUALITY, subsampling=0)
    return path.name
