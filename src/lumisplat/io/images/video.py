"""MP4 videos (H.264) out of pictures, by PyAV. The file appears whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError, MissingExtraError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.image import to_bytes

_FPS_MAX = 240.0
"""Frames a second: the most that H.264's level 5.1 has for any size of interest."""
_FPS_DENOMINATOR = 1001
"""Of frame rates: 24, 12.5 and 30000/1001 are exact."""
_QUALITY = {"crf": "16", "preset": "medium"}
"""x264's constant rate factor at which coding is hardly seen; 23 is its default."""
_BT709 = 1
"""Of primaries, transfer and matrix (ITU-T H.273)."""
_LIMITED_RANGE = 1
"""Luma 16..235 (FFmpeg's AVCOL_RANGE_MPEG)."""


def write_video(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float) -> None:
    """Writes an H.264 video that every player shows: 4:2:0, BT.709, limited range, the index in front.

    Frames are taken one by one: they need not be in memory together. Where width or height is odd, the last column or
    row is repeated, for colours have half the resolution each way.

    Args:
        path: Where to.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3).
        fps: Frames a second, above 0, at most 240; exact as a fraction with a denominator of at most 1001.

    Raises:
        ConfigError: ``fps`` is out of range.
        SceneError: There is no frame, one is no such image, or sizes differ.
        FormatError: The file cannot be written.
        MissingExtraError: PyAV is not installed.
    """
    try:
        import av
        from av.error import FFmpegError
    except ImportError:
        raise MissingExtraError("a video", "video") from None
    if not 0.0 < fps <= _FPS_MAX:
        raise ConfigError(f"fps is {fps}, expected more than 0, at most {_FPS_MAX:g}")
    rate = Fraction(fps).limit_denominator(_FPS_DENOMINATOR)
    pictures = (to_bytes(frame, path) for frame in frames)
    first = next(pictures, None)
    if first is None or first.shape[2] != 3:
        raise SceneError(
            f"a video takes pictures of one shape (H, W, 3), got {'none' if first is None else first.shape}"
        )
    with atomic_write(path) as temporary:
        try:
            with av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container:
                stream = container.add_stream("libx264", rate=rate, options=_QUALITY)
                stream.height, stream.width = (size + size % 2 for size in first.shape[:2])
                stream.pix_fmt = "yuv420p"
                coding = stream.codec_context
                coding.color_primaries = coding.color_trc = coding.colorspace = _BT709
                coding.color_range = _LIMITED_RANGE
                for number, picture in enumerate(chain([first], pictures)):
                    if picture.shape != first.shape:
                        shapes = sorted({picture.shape, first.shape})
                        raise SceneError(f"a video takes pictures of one shape (H, W, 3), got {shapes}")
                    frame = av.VideoFrame.from_ndarray(_even(picture), format="rgb24").reformat(
                        format="yuv420p", dst_colorspace="ITU709", src_color_range="JPEG", dst_color_range="MPEG"
                    )
                    frame.pts, frame.time_base = number, 1 / rate
                    container.mux(stream.encode(frame))
                container.mux(stream.encode())
        except FFmpegError as error:
            raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


def _even(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """The picture, its last row and column repeated where their number is odd."""
    height, width, _ = picture.shape
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
