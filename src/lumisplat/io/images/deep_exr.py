"""Deep OpenEXR files: of each pixel a list of samples at their depths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.native import native_write, utf8_path
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray, Rows


def write_deep_exr(path: PathLike, size: tuple[int, int], first: Rows, channels: Mapping[str, FloatArray]) -> None:
    """Writes a one-part deep scanline EXR, ZIP-compressed line by line, of 32-bit floats.

    Args:
        path: The file to write. It appears complete or not at all.
        size: Rows and columns, (H, W).
        first: Row of the first sample of each pixel, pixels row by row, and how many there are at the end, (H W + 1,).
        channels: ``R``, ``G``, ``B``, ``A``, ``Z``, ``ZBack``, one value a sample.

    Raises:
        FormatError: The file cannot be written.
    """
    import OpenEXR

    package: Any = OpenEXR  # typed without what is deep
    header = {"compression": package.ZIPS_COMPRESSION, "type": package.deepscanline}
    planes = {name: _lists(values, size, first) for name, values in channels.items()}
    with atomic_write(path) as temporary, utf8_path(temporary) as text, OpenEXR.File(header, planes) as file:
        with native_write(path, text):
            file.write(text)


def _lists(values: FloatArray, size: tuple[int, int], first: Rows) -> npt.NDArray[Any]:
    """A list of values for each pixel, as OpenEXR takes them."""
    held = np.ascontiguousarray(values, dtype=np.float32)
    lists = np.empty(size[0] * size[1], dtype=object)
    for pixel, (begin, end) in enumerate(zip(first[:-1].tolist(), first[1:].tolist(), strict=True)):
        lists[pixel] = held[begin:end]
    return lists.reshape(size)
