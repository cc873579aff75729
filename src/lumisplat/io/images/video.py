"""Writes frames as GIF, WebP or animated PNG, or as MP4 video (H.264) with PyAV."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError, FormatError, MissingExtraError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.texture import to_bytes

if TYPE_CHECKING:
    from PIL import Image

_Bytes = npt.NDArray[np.uint8]

_FPS_MAX = 50.0
"""Largest frames per second of image animations: browsers show a GIF frame shorter than 20 ms for 100 ms."""
_PALETTE_PIXELS = 100_000
"""Number of pixels, sampled from all frames, from which a GIF palette is chosen. More make no visible difference."""

_VIDEO_FPS_MAX = 240.0
"""Largest frames per second of a video; H.264 level 5.1 allows this rate at common sizes."""
_FPS_DENOMINATOR = 1001
"""Frame rates are rounded to fractions with at most this denominator: 24, 12.5 and 30000/1001 stay exact."""
_QUALITY = {"crf": "16", "preset": "medium"}
"""x264 options. At constant rate factor 16, compression is hardly visible; x264's default is 23."""
_BT709 = 1
"""Code in ITU-T H.273 of BT.709: the same for primaries, transfer function and matrix."""
_LIMITED_RANGE = 1
"""FFmpeg's code AVCOL_RANGE_MPEG of limited range, in which luma is 16..235."""


def write_animation(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float) -> None:
    """Writes an animation or a video; see `lumisplat.io.save_animation`."""
    from PIL import Image

    suffix = Path(path).suffix.lower()
    if suffix == ".mp4":
        _write_video(path, frames, fps)
        return
    if suffix not in (".gif", ".webp", ".png", ".apng"):
        expected = ".mp4, .gif, .webp, .png or .apng"
        raise FormatError(path, f"unknown extension '{suffix}' of an animation, expected {expected}")
    if not 0.0 < fps <= _FPS_MAX:
        raise ConfigError(f"fps is {fps}, expected more than 0, at most {_FPS_MAX:g}")
    frames_8bit = [to_bytes(frame, path) for frame in frames]
    if len({frame_8bit.shape for frame_8bit in frames_8bit}) != 1 or frames_8bit[0].shape[2] != 3:
        shapes = sorted({frame_8bit.shape for frame_8bit in frames_8bit})
        raise SceneError(f"an animation needs frames of one shape (H, W, 3), got {shapes or 'none'}")
    if suffix == ".gif":
        images = _quantise(frames_8bit)
        # Given the palette, Pillow does not repeat it for each frame.
        options: dict[str, Any] = {"format": "GIF", "optimize": False, "palette": _palette_bytes(images[0])}
    else:
        images = [Image.fromarray(frame_8bit) for frame_8bit in frames_8bit]
        options = {"format": "WEBP", "quality": 90} if suffix == ".webp" else {"format": "PNG"}
    with atomic_write(path) as temporary:
        durations = _durations_ms(len(images), fps, unit=10 if suffix == ".gif" else 1)
        images[0].save(temporary, save_all=True, append_images=images[1:], duration=durations, loop=0, **options)


def _durations_ms(count: int, fps: float, unit: int) -> list[int]:
    """Returns the duration in milliseconds of each of ``count`` frames, a multiple of ``unit`` milliseconds.

    Durations are rounded such that each frame ends at most half a unit before or after its exact time.
    """
    ends = np.floor(np.arange(count + 1) * 1000.0 / (fps * unit) + 0.5).astype(int)
    return [int(length) * unit for length in np.diff(ends)]


def _quantise(frames_8bit: list[_Bytes]) -> list[Image.Image]:
    """Quantises frames to one palette of 256 colours, with ordered dithering."""
    from PIL import Image

    # An odd step samples pixels of all columns.
    step = max(1, len(frames_8bit) * frames_8bit[0].size // (3 * _PALETTE_PIXELS)) | 1
    samples = np.concatenate([frame_8bit.reshape(-1, 3)[::step] for frame_8bit in frames_8bit])
    # Maximum coverage, because median cut leaves no colour for small objects.
    palette = Image.fromarray(samples[None]).quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3)
    colors = np.unique(np.array(palette.getpalette()).reshape(-1, 3), axis=0).astype(np.float64)
    distances = np.linalg.norm(colors[:, None] - colors[None], axis=2) + 1e9 * np.eye(len(colors))
    height, width, _ = frames_8bit[0].shape
    y, x = np.mgrid[:height, :width]
    # Interleaved gradient noise (Jimenez 2014): unlike white noise, each 3 x 3 pixels contain all values about once.
    # Its amplitude is about the distance between colours of the palette.
    noise = (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1.0)) % 1.0 - 0.5
    offsets = np.median(distances.min(axis=1)) * noise[..., None] + 0.5
    images: list[Image.Image] = []
    for frame_8bit in frames_8bit:
        noisy = np.clip(frame_8bit + offsets, 0.0, 255.0).astype(np.uint8)
        images.append(Image.fromarray(noisy).quantize(palette=palette, dither=Image.Dither.NONE))
    return images


def _palette_bytes(image: Image.Image) -> bytes:
    return bytes(image.getpalette() or ()).ljust(768, b"\0")


def _write_video(path: PathLike, frames: Iterable[npt.ArrayLike], fps: float) -> None:
    """Writes an H.264 video that all players support: 4:2:0, BT.709, limited range, with the index at the start.

    Frames are consumed one by one and need not be in memory together. If width or height is odd, the last column or row
    is repeated, because chroma has half the resolution in both directions.

    Args:
        path: The file to write. It appears complete or not at all.
        frames: Display-referred values, 0..1, each of the same shape (H, W, 3).
        fps: Frames per second, above 0, at most 240, rounded to a fraction with a denominator of at most 1001.
    """
    try:
        av: Any = import_module("av")  # most of its types are unknown
    except ImportError:
        raise MissingExtraError("a video", "video") from None
    if not 0.0 < fps <= _VIDEO_FPS_MAX:
        raise ConfigError(f"fps is {fps}, expected more than 0, at most {_VIDEO_FPS_MAX:g}")
    frames_8bit = _with_equal_shapes(to_bytes(frame, path) for frame in frames)
    first = next(frames_8bit)
    with atomic_write(path) as temporary:
        try:
            rate = Fraction(fps).limit_denominator(_FPS_DENOMINATOR)
            _encode(av, temporary, chain([first], frames_8bit), first.shape, rate)
        except av.error.FFmpegError as error:
            raise FormatError(path, f"cannot be written: {error.strerror or error}") from None


def _with_equal_shapes(frames_8bit: Iterable[_Bytes]) -> Iterator[_Bytes]:
    """Yields the frames one by one, and raises `SceneError` if their shapes differ or are not (H, W, 3)."""
    expected = "a video needs frames of one shape (H, W, 3), got"
    shape: tuple[int, ...] | None = None
    for frame_8bit in frames_8bit:
        if shape is None:
            shape = frame_8bit.shape
            if shape[2] != 3:
                raise SceneError(f"{expected} {shape}")
        if frame_8bit.shape != shape:
            raise SceneError(f"{expected} {sorted({frame_8bit.shape, shape})}")
        yield frame_8bit
    if shape is None:
        raise SceneError(f"{expected} none")


def _encode(av: Any, path: Path, frames_8bit: Iterable[_Bytes], shape: tuple[int, ...], rate: Fraction) -> None:
    """Encodes frames of one shape with PyAV."""
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options=_QUALITY)
        stream.height, stream.width = (size + size % 2 for size in shape[:2])
        stream.pix_fmt = "yuv420p"
        coding = stream.codec_context
        coding.color_primaries = coding.color_trc = coding.colorspace = _BT709
        coding.color_range = _LIMITED_RANGE
        for number, frame_8bit in enumerate(frames_8bit):
            frame = av.VideoFrame.from_ndarray(_even(frame_8bit), format="rgb24").reformat(
                format="yuv420p", dst_colorspace="ITU709", src_color_range="JPEG", dst_color_range="MPEG"
            )
            frame.pts, frame.time_base = number, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def _even(frame_8bit: _Bytes) -> _Bytes:
    """Returns the frame with even height and width: if the number of rows or columns is odd, the last is repeated."""
    height, width, _ = frame_8bit.shape
    return np.pad(frame_8bit, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
