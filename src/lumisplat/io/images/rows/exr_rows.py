"""OpenEXR files of scanlines, ZIP-compressed, written some rows at a time (openexr.com, File Layout)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

_MAGIC = 20000630
_VERSION, _LONG_NAMES = 2, 0x400
_SHORT_NAME = 31
"""Longest name without that flag, bytes."""
_BLOCK_ROWS = 16
"""Rows that ZIP compresses together."""
_ZIP = 3
_KINDS = {"u": (0, "<u4"), "f": (2, "<f4")}
"""Types of pixels by those of arrays: 32-bit unsigned numbers, and floats."""

Rows = Mapping[str, npt.NDArray[Any]]
"""Rows of all channels by their names, each float32 or uint32, shape (R, W)."""


class ExrRows:
    """Writes an image from top to bottom.

    Args:
        file: Open for writing, at its beginning; it must be seekable.
        width: Of the image, pixels.
        height: Likewise.
        channels: Names, and ``f`` for float32 or ``u`` for uint32.
    """

    def __init__(self, file: BinaryIO, width: int, height: int, channels: Mapping[str, str]) -> None:
        self._file, self._width, self._height = file, width, height
        self._kinds = {name: channels[name] for name in sorted(channels)}
        file.write(_header(width, height, self._kinds))
        self._table = file.tell()
        self._places: list[int] = []
        file.write(bytes(8 * -(-height // _BLOCK_ROWS)))
        self._waiting: list[bytes] = []
        self._row = 0

    def __enter__(self) -> ExrRows:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        if error is None:
            self._file.seek(self._table)
            self._file.write(struct.pack(f"<{len(self._places)}Q", *self._places))

    def write(self, rows: Rows) -> None:
        """Writes the next rows."""
        planes = [np.ascontiguousarray(rows[name], _KINDS[kind][1]) for name, kind in self._kinds.items()]
        for row in zip(*planes, strict=True):
            self._waiting.append(b"".join(plane.tobytes() for plane in row))
            self._row += 1
            if self._row % _BLOCK_ROWS == 0 or self._row == self._height:
                self._write_block()

    def _write_block(self) -> None:
        first = self._row - len(self._waiting)
        content = b"".join(self._waiting)
        packed = zlib.compress(_predicted(content), 4)
        if len(packed) >= len(content):
            packed = content
        self._places.append(self._file.tell())
        self._file.write(struct.pack("<ii", first, len(packed)) + packed)
        self._waiting = []


def _predicted(content: bytes) -> bytes:
    """Bytes at even places, then those at odd ones, each as its difference from the one before."""
    stored = np.frombuffer(content, np.uint8)
    parted = np.concatenate([stored[::2], stored[1::2]])
    parted[1:] = np.diff(parted) + np.uint8(128)
    return parted.tobytes()


def _header(width: int, height: int, kinds: Mapping[str, str]) -> bytes:
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    flags = _LONG_NAMES if any(len(name.encode()) > _SHORT_NAME for name in kinds) else 0
    attributes: Sequence[tuple[str, str, bytes]] = (
        ("channels", "chlist", b"".join(_channel(name, kind) for name, kind in kinds.items()) + b"\0"),
        ("compression", "compression", bytes([_ZIP])),
        ("dataWindow", "box2i", box),
        ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    )
    parts = [
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    ]
    return struct.pack("<ii", _MAGIC, _VERSION | flags) + b"".join(parts) + b"\0"


def _channel(name: str, kind: str) -> bytes:
    """A channel in the list of a header: its name, its type, linear or not, and its sampling."""
    return name.encode() + b"\0" + struct.pack("<iiii", _KINDS[kind][0], 0, 1, 1)
