"""PNG files (W3C Recommendation of 2003) of 8-bit pixels, written some rows at a time."""

from __future__ import annotations

import struct
import zlib
from types import TracebackType
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

_Bytes = npt.NDArray[np.uint8]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOR_TYPES = {3: 2, 4: 6}
"""Of RGB and RGBA, by their channels."""
_FILTERS = (1, 2, 4)
"""Those that are tried of each row: Sub, Up and Paeth."""


class PngRows:
    """Writes an image from top to bottom.

    Args:
        file: Open for writing, at its beginning.
        width: Of the image, pixels.
        height: Likewise.
        channels: 3 (RGB) or 4 (RGBA, straight alpha).
    """

    def __init__(self, file: BinaryIO, width: int, height: int, channels: int) -> None:
        self._file, self._channels = file, channels
        self._compressor = zlib.compressobj(6)
        self._above: _Bytes = np.zeros(width * channels, np.uint8)
        file.write(_SIGNATURE)
        self._chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, _COLOR_TYPES[channels], 0, 0, 0))

    def __enter__(self) -> PngRows:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        if error is None:
            self._chunk(b"IDAT", self._compressor.flush())
            self._chunk(b"IEND", b"")

    def write(self, pixels: _Bytes) -> None:
        """Writes the next rows, shape (R, W, channels)."""
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
        packed = bytearray()
        for row in rows:
            packed += self._compressor.compress(self._filtered(row))
            self._above = row
        if packed:
            self._chunk(b"IDAT", bytes(packed))

    def _filtered(self, row: _Bytes) -> bytes:
        """A row as differences from what is beside it, by the filter whose differences are smallest in sum."""
        left, corner = self._beside(row), self._beside(self._above)
        found = row - left, row - self._above, row - _paeth(left, self._above, corner)
        sizes = [int(np.abs(differences.view(np.int8).astype(np.int16)).sum(dtype=np.int64)) for differences in found]
        best = int(np.argmin(sizes))
        return bytes([_FILTERS[best]]) + found[best].tobytes()

    def _beside(self, row: _Bytes) -> _Bytes:
        """Each byte's like in the pixel to the left."""
        return np.concatenate([np.zeros(self._channels, np.uint8), row[: -self._channels]])

    def _chunk(self, name: bytes, content: bytes) -> None:
        check = zlib.crc32(content, zlib.crc32(name))
        self._file.write(struct.pack(">I", len(content)) + name + content + struct.pack(">I", check))


def _paeth(left: _Bytes, above: _Bytes, corner: _Bytes) -> _Bytes:
    """The nearest of three neighbours to ``left + above - corner``; of equally near ones the first."""
    a, b, c = (one.astype(np.int16) for one in (left, above, corner))
    to_a, to_b, to_c = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
    return np.where((to_a <= to_b) & (to_a <= to_c), left, np.where(to_b <= to_c, above, corner)).astype(np.uint8)
