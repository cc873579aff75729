"""MP4 videos (H.264) from pictures, by PyAV."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError, MissingExtraError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.png import to_bytes

_Bytes = npt.NDArray[np.uint8]

_FPS_MAX = 240.0
"""Largest number of frames per second: that of H.264's level 5.1 for common sizes."""
_FPS_DENOMINATOR = 1001
"""Largest denominator of frame rates: 24, 12.5 and 30000/1001 are exact."""
_QUALITY = {"crf": "16", "preset": "medium"}
"""x264's constant rate factor (its default is 23) at which compression is hardly visible."""
_BT709 = 1
"""Code of the primaries, the transfer function and the matrix (ITU-T H.273)."""
_LIMITED_RANGE = 1
"""Luma 16..235 (FFmpeg's AVCOL_RANGE_MPEG)."""


def write_video(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float) -> None:
    """Writes an H.264 video that all players show: 4:2:0, BT.709, limited range, with the index at the start.

    Frames are taken one by one, so that they need not be in memory together. If width or height is odd, the last column
    or row is repeated, because colours have half the resolution in both directions.

    Args:
        path: The file to write. It appears complete or not at all.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3).
        fps: Frames per second, above 0, at most 240, rounded to a fraction with a denominator of at most 1001.

    Raises:
        ConfigError: ``fps`` is out of range.
        SceneError: There is no frame, a frame has the wrong shape, or sizes differ.
        FormatError: The file cannot be written.
        MissingExtraError: PyAV is not installed.
    """
    try:
        av: Any = import_module("av")  # most of its types are unknown
    except ImportError:
        raise MissingExtraError("a video", "video") from None
    if not 0.0 < fps <= _FPS_MAX:
        raise ConfigError(f"fps is {fps}, expected more than 0, at most {_FPS_MAX:g}")
    pictures = _with_equal_shapes(to_bytes(frame, path) for frame in frames)
    first = next(pictures)
    with atomic_write(path) as temporary:
        try:
            rate = Fraction(fps).limit_denominator(_FPS_DENOMINATOR)
            _encode(av, temporary, chain([first], pictures), first.shape, rate)
        except av.error.FFmpegError as error:
            raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


def _with_equal_shapes(pictures: Iterable[_Bytes]) -> Iterator[_Bytes]:
    """The pictures, one by one.

    Raises:
        SceneError: There is none, or their shapes are not one shape (H, W, 3).
    """
    expected = "a video takes pictures of one shape (H, W, 3), got"
    shape: tuple[int, ...] | None = None
    for picture in pictures:
        if shape is None:
            shape = picture.shape
            if shape[2] != 3:
                raise SceneError(f"{expected} {shape}")
        if picture.shape != shape:
            raise SceneError(f"{expected} {sorted({picture.shape, shape})}")
        yield picture
    if shape is None:
        raise SceneError(f"{expected} none")


def _encode(av: Any, path: Path, pictures: Iterable[_Bytes], shape: tuple[int, ...], rate: Fraction) -> None:
    """Encodes pictures of one shape with PyAV."""
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options=_QUALITY)
        stream.height, stream.width = (size + size % 2 for size in shape[:2])
        stream.pix_fmt = "yuv420p"
        coding = stream.codec_context
        coding.color_primaries = coding.color_trc = coding.colorspace = _BT709
        coding.color_range = _LIMITED_RANGE
        for number, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(_even(picture), format="rgb24").reformat(
                format="yuv420p", dst_colorspace="ITU709", src_color_range="JPEG", dst_color_range="MPEG"
            )
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _even(picture: _Bytes) -> _Bytes:
    """The picture, with its last row or column repeated if their number is odd."""
    height, width, _ = picture.shape
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
