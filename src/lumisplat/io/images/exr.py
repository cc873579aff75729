"""Reads and writes OpenEXR images: named channels of floats or integers, and deep samples."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.native import native_write, silenced_native_output, utf8_path
from lumisplat.io.files.source import PathLike, check_expansion, read_bytes
from lumisplat.math.arrays import FloatArray, Rows, host_array

Channel = npt.NDArray[Any]
"""Pixels of one channel, shape (H, W)."""


@dataclass(frozen=True)
class ExrPart:
    """One part of a multi-part EXR, an image with its own channels and header."""

    name: str
    channels: Mapping[str, Channel]
    """Pixels by channel name, such as ``R`` or ``depth.Z``, all of one shape (H, W)."""
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])
    """String attributes of the part's header, by name."""


def write_exr(
    path: PathLike,
    channels: Mapping[str, Channel],
    metadata: Mapping[str, str] | None = None,
    further: Iterable[ExrPart] = (),
) -> None:
    """Writes a scanline EXR, ZIP-compressed, with channels exactly as named (Nuke reads ``layer.channel``).

    Args:
        path: The file to write. It appears complete or not at all.
        channels: Pixels of ``"R"``, ``"depth.Z"``, ``"normal.X"`` and so on, all of one shape (H, W). Floating-point
            arrays are stored as 32-bit float (infinities are preserved), integer arrays as 32-bit unsigned: -1 ("none")
            reads back as 4294967295.
        metadata: Header attributes.
        further: Parts after the first one. Most programs except compositors read only the first part, which holds
            ``channels``. The first header also gets the attributes of all parts, because some compositors look only
            there.

    Raises:
        SceneError: There is no channel, or shapes differ.
        FormatError: The file cannot be written.
    """
    import OpenEXR

    further = list(further)
    if further:
        merged = dict(metadata or {})
        for part in further:
            merged |= part.metadata
        rows = [ExrPart("rgba", channels, merged), *further]
        part_of: Any = OpenEXR.Part  # its stub lacks the arguments
        content: Any = [part_of(_header(part.metadata), _planes(part.channels), part.name) for part in rows]
        made = OpenEXR.File(content)
    else:
        made = OpenEXR.File(_header(metadata or {}), _planes(channels))
    with atomic_write(path) as temporary, utf8_path(temporary) as text, made as file:
        with native_write(path, text):
            file.write(text)


def _header(metadata: Mapping[str, str]) -> dict[str, Any]:
    import OpenEXR

    return {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **metadata}


def _planes(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Converts each channel to the type in which it is stored, shape (H, W).

    Channels are separate arrays, because the OpenEXR library would rename the channels of a (H, W, 3) array.
    """
    shapes = {np.shape(host_array(pixels)) for pixels in channels.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2 or 0 in next(iter(shapes)):
        raise SceneError(f"EXR channels must share one shape (H, W), got {sorted(shapes) or 'no channel'}")
    return {name: _stored_pixels(np.asarray(host_array(pixels))) for name, pixels in channels.items()}


def _stored_pixels(pixels: Channel) -> Channel:
    if pixels.dtype.kind in "iub":
        return np.ascontiguousarray(pixels).astype(np.int64).astype(np.uint32)
    return np.ascontiguousarray(pixels, dtype=np.float32)


def read_exr(path: PathLike) -> dict[str, Channel]:
    """Reads the channels of an EXR's first part by their full names, each float16, float32 or uint32, shape (H, W).

    Raises:
        FormatError: The file is missing, damaged, not an EXR, or claims more pixels than its size can hold.
    """
    import OpenEXR

    stored_bytes = len(read_bytes(path))
    with utf8_path(path) as text, silenced_native_output():  # OpenEXR prints messages about damaged files
        try:
            with OpenEXR.File(text, header_only=True) as file:
                low, high = file.header()["dataWindow"]
                count = len(file.header()["channels"])
            width, height = (int(size) for size in np.subtract(high, low) + 1)
            check_expansion(
                path, f"{width} x {height} pixels of {count} channels", 4 * width * height * count, stored_bytes
            )
            with OpenEXR.File(text, separate_channels=True) as file:
                return {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        except FormatError:
            raise
        except Exception as error:  # the binding raises RuntimeError, TypeError or its own errors
            raise FormatError(path, "damaged, or not an EXR file") from error


def write_deep_exr(path: PathLike, size: tuple[int, int], first: Rows, channels: Mapping[str, FloatArray]) -> None:
    """Writes a one-part deep scanline EXR of 32-bit floats, ZIP-compressed line by line.

    Args:
        path: The file to write. It appears complete or not at all.
        size: Rows and columns of the image, (H, W).
        first: Index of the first sample of each pixel, row by row, followed by the total number of samples, shape
            (H W + 1,).
        channels: Values of ``R``, ``G``, ``B``, ``A``, ``Z`` and ``ZBack``, one per sample.

    Raises:
        FormatError: The file cannot be written.
    """
    import OpenEXR

    package: Any = OpenEXR  # its stub lacks deep images
    header = {"compression": package.ZIPS_COMPRESSION, "type": package.deepscanline}
    planes = {name: _lists(values, size, first) for name, values in channels.items()}
    with atomic_write(path) as temporary, utf8_path(temporary) as text, OpenEXR.File(header, planes) as file:
        with native_write(path, text):
            file.write(text)


def _lists(values: FloatArray, size: tuple[int, int], first: Rows) -> npt.NDArray[Any]:
    """Splits the values of a deep channel by pixel: an array of arrays, shape (H, W), as the OpenEXR library expects.

    ``first`` has the index of each pixel's first value, as in `write_deep_exr`.
    """
    held = np.ascontiguousarray(values, dtype=np.float32)
    lists = np.empty(size[0] * size[1], dtype=object)
    for pixel, (begin, end) in enumerate(zip(first[:-1].tolist(), first[1:].tolist(), strict=True)):
        lists[pixel] = held[begin:end]
    return lists.reshape(size)
