"""Joins the image files of a camera's windows to one PNG or OpenEXR file. One row of windows is in memory at a time.

PNG (W3C Recommendation of 2003) has 8-bit pixels; OpenEXR has ZIP-compressed scanlines (openexr.com, File Layout).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.images.exr import read_exr

_MAGIC = 20000630
_VERSION, _LONG_NAMES = 2, 0x400
_SHORT_NAME = 31
"""Length in bytes of the longest channel name that OpenEXR stores without a flag for long names."""
_BLOCK_ROWS = 16
"""Number of image rows that OpenEXR's ZIP method compresses together."""
_ZIP = 3
_KINDS = {"u": (0, "<u4"), "f": (2, "<f4")}
"""OpenEXR pixel type and NumPy type of 32-bit unsigned integers ("u") and floats ("f")."""

Rows = Mapping[str, npt.NDArray[Any]]
"""Consecutive rows of every channel by channel name, each float32 or uint32, shape (rows, width)."""

_Bytes = npt.NDArray[np.uint8]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOR_TYPES = {3: 2, 4: 6}
"""PNG's code for the colour type by number of channels: 3 (RGB) or 4 (RGBA)."""
_FILTERS = (1, 2, 4)
"""PNG filters that are tried for each row: Sub, Up and Paeth."""

Window = tuple[int, int, int, int]
"""Position and size of a window in the image: left, top, width and height, pixels."""


class ExrRows:
    """Writes an OpenEXR image from top to bottom.

    Args:
        file: Seekable file, open for writing, at its beginning.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        channels: Channel names, with ``f`` for float32 or ``u`` for uint32.
    """

    def __init__(self, file: BinaryIO, width: int, height: int, channels: Mapping[str, str]) -> None:
        self._file, self._width, self._height = file, width, height
        self._kinds = {name: channels[name] for name in sorted(channels)}
        file.write(_header(width, height, self._kinds))
        self._table = file.tell()
        self._offsets: list[int] = []
        file.write(bytes(8 * -(-height // _BLOCK_ROWS)))
        self._waiting: list[bytes] = []
        self._row = 0

    def __enter__(self) -> ExrRows:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        if error is None:
            self._file.seek(self._table)
            self._file.write(struct.pack(f"<{len(self._offsets)}Q", *self._offsets))

    def write(self, rows: Rows) -> None:
        """Writes the next rows of the image; they are compressed in groups of 16."""
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
        self._offsets.append(self._file.tell())
        self._file.write(struct.pack("<ii", first, len(packed)) + packed)
        self._waiting = []


def _predicted(content: bytes) -> bytes:
    """Applies OpenEXR's ZIP predictor to bytes.

    Bytes at even offsets come first, then bytes at odd offsets. Each byte but the first is then replaced by its
    difference from the byte before it, plus 128.
    """
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
    """Encodes a channel for the OpenEXR header's channel list; ``kind`` is ``f`` (float32) or ``u`` (uint32)."""
    return name.encode() + b"\0" + struct.pack("<iiii", _KINDS[kind][0], 0, 1, 1)


class PngRows:
    """Writes a PNG image from top to bottom.

    Args:
        file: File open for writing, at its beginning.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
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
        """Writes the next rows of the image, shape (rows, width, channels)."""
        rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1)
        packed = bytearray()
        for row in rows:
            packed += self._compressor.compress(self._filtered(row))
            self._above = row
        if packed:
            self._chunk(b"IDAT", bytes(packed))

    def _filtered(self, row: _Bytes) -> bytes:
        """Filters a row by the PNG filter that makes the sum of absolute differences smallest."""
        left, corner = self._left_neighbors(row), self._left_neighbors(self._above)
        candidates = row - left, row - self._above, row - _paeth(left, self._above, corner)
        sizes = [
            int(np.abs(differences.view(np.int8).astype(np.int16)).sum(dtype=np.int64)) for differences in candidates
        ]
        best = int(np.argmin(sizes))
        return bytes([_FILTERS[best]]) + candidates[best].tobytes()

    def _left_neighbors(self, row: _Bytes) -> _Bytes:
        """Returns, for each byte of a row, the same channel of the pixel to the left; 0 for the first pixel."""
        return np.concatenate([np.zeros(self._channels, np.uint8), row[: -self._channels]])

    def _chunk(self, name: bytes, content: bytes) -> None:
        check = zlib.crc32(content, zlib.crc32(name))
        self._file.write(struct.pack(">I", len(content)) + name + content + struct.pack(">I", check))


def _paeth(left: _Bytes, above: _Bytes, corner: _Bytes) -> _Bytes:
    """Returns the nearest to ``left + above - corner`` of ``left``, ``above`` and ``corner``; on ties the first."""
    a, b, c = (one.astype(np.int16) for one in (left, above, corner))
    to_a, to_b, to_c = np.abs(b - c), np.abs(a - c), np.abs(a + b - 2 * c)
    return np.where((to_a <= to_b) & (to_a <= to_c), left, np.where(to_b <= to_c, above, corner)).astype(np.uint8)


def join_windows(path: PathLike, windows: Mapping[Window, PathLike]) -> None:
    """Joins files of a camera's windows (`Camera.window`) to one image, with unchanged pixels.

    Args:
        path: The image to write, ``.png`` (8-bit RGB or RGBA) or ``.exr`` (all channels of the window files). It
            appears complete or not at all.
        windows: Files by window, all in the format of ``path``. Windows form rows without gaps, and all windows of a
            row have the same height.

    Raises:
        SceneError: The windows do not tile an image.
        FormatError: A window file is missing, damaged, or has other channels than the first; the image cannot be
            written, or has another extension.
    """
    rows = _in_rows(windows)
    size = max(left + width for left, _, width, _ in windows), max(top + height for _, top, _, height in windows)
    suffix = Path(path).suffix.lower()
    if suffix not in (".png", ".exr"):
        raise FormatError(path, f"windows can be joined to .png and .exr, not to '{suffix}'")
    join = _join_png if suffix == ".png" else _join_exr
    join(path, [{window: windows[window] for window in row} for row in rows], size)


def _in_rows(windows: Mapping[Window, PathLike]) -> list[list[Window]]:
    """Groups windows by row, each row from left to right.

    Raises:
        SceneError: The windows leave gaps or overlap, so that they do not tile an image.
    """
    if not windows:
        raise SceneError("there is no window to join")
    rows = [
        [window for window in sorted(windows) if window[1] == top] for top in sorted({window[1] for window in windows})
    ]
    right, bottom = rows[0][-1][0] + rows[0][-1][2], 0
    for row in rows:
        beside = 0
        for left, top, width, height in row:
            if left != beside or top != bottom or height != row[0][3]:
                raise SceneError(f"the window ({left}, {top}, {width}, {height}) leaves a gap, or overlaps another one")
            beside = left + width
        if beside != right:
            raise SceneError(f"the windows at row {bottom} end at column {beside}, others at {right}")
        bottom += row[0][3]
    return rows


def _join_png(path: PathLike, rows: list[dict[Window, PathLike]], size: tuple[int, int]) -> None:
    first = next(iter(rows[0].items()))
    channels = _png_pixels(first[1], first[0], None).shape[2]
    with atomic_write(path) as temporary, open(temporary, "wb") as file, PngRows(file, *size, channels) as written:
        for row in rows:
            parts = [_png_pixels(part, window, channels) for window, part in row.items()]
            written.write(np.concatenate(parts, axis=1))


def _png_pixels(path: PathLike, window: Window, channels: int | None) -> npt.NDArray[np.uint8]:
    """Reads the pixels of a window's PNG, shape (H, W, 3) for RGB or (H, W, 4) for RGBA.

    Args:
        path: The file.
        window: Window that the file shows, with its expected size.
        channels: Number of channels of the other windows; None for the first window.

    Raises:
        FormatError: The file is damaged, or differs in size or channels.
    """
    from PIL import Image

    try:
        Image.MAX_IMAGE_PIXELS, limit = None, Image.MAX_IMAGE_PIXELS  # the size is checked against the window instead
        try:
            with Image.open(path, formats=("PNG",)) as image:
                if image.size != window[2:] or image.mode not in ("RGB", "RGBA"):
                    raise FormatError(
                        path, f"has size {image.size} and mode {image.mode}, expected {window[2:]} and RGB or RGBA"
                    )
                pixels = np.asarray(image)
        finally:
            Image.MAX_IMAGE_PIXELS = limit
    except FormatError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        raise FormatError(path, f"cannot be read as the PNG of a window: {error}") from None
    if channels is not None and pixels.shape[2] != channels:
        raise FormatError(path, f"has {pixels.shape[2]} channels, but other windows have {channels}")
    return pixels


def _join_exr(path: PathLike, rows: list[dict[Window, PathLike]], size: tuple[int, int]) -> None:
    first = next(iter(rows[0].items()))
    kinds = {name: image.dtype.kind for name, image in _exr_channels(first[1], first[0], None).items()}
    with atomic_write(path) as temporary, open(temporary, "wb") as file, ExrRows(file, *size, kinds) as written:
        for row in rows:
            parts = [_exr_channels(part, window, kinds) for window, part in row.items()]
            written.write({name: np.concatenate([part.pop(name) for part in parts], axis=1) for name in kinds})


def _exr_channels(path: PathLike, window: Window, kinds: Mapping[str, str] | None) -> dict[str, npt.NDArray[Any]]:
    """Reads the channels of a window's EXR by name, shape (H, W) each.

    Args:
        path: The file.
        window: Window that the file shows, with its expected size.
        kinds: ``f`` or ``u`` by channel name as in the other windows; None for the first window.

    Raises:
        FormatError: The file is damaged, or differs in size or channels.
    """
    channels = read_exr(path)
    shapes = {image.shape for image in channels.values()}
    if shapes != {(window[3], window[2])}:
        raise FormatError(path, f"has channels of (rows, columns) {shapes}, expected {(window[3], window[2])}")
    if kinds is not None and {name: image.dtype.kind for name, image in channels.items()} != dict(kinds):
        raise FormatError(path, "has channels that differ from those of other windows")
    return channels
