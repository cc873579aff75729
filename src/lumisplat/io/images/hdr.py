"""Radiance HDR files (.hdr, .pic): RGBE pixels, flat or in one of the two run-length encodings.

After Greg Ward, "Real Pixels" (Graphics Gems II, 1991) and the Radiance manual, section on picture files.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.limits import check_expansion
from lumisplat.io.files.source import PathLike

MAGIC = b"#?"

_HEADER_BYTES_MAX = 2**16
_ENCODED_WIDTHS = range(8, 2**15)
"""Widths for which the newer run-length encoding exists."""


class _Header(NamedTuple):
    width: int
    height: int
    exposure: npt.NDArray[np.float64]
    """Factors by which the pixels were multiplied, one per channel, shape (3,)."""
    size: int
    """Bytes before the pixels."""


def decode_hdr(path: PathLike, data: bytes) -> npt.NDArray[np.float32]:
    """Linear radiance, divided by the exposures that the header lists, shape (H, W, 3), row 0 at the top.

    A mantissa m with exponent e is ``m 2^(e - 136)``, as in most readers, which keeps whole numbers exact.

    Args:
        path: Named in errors.
        data: The whole file.

    Raises:
        FormatError: The file is damaged or truncated, has XYZ colours, or rows and columns in another order.
    """
    header = _read_header(path, data)
    check_expansion(path, f"{header.width} x {header.height} pixels", 12 * header.width * header.height, len(data))
    rows = np.empty((header.height, header.width, 4), np.uint8)
    at = header.size
    for y in range(header.height):
        try:
            row, at = _read_row(data, at, header.width)
        except IndexError:
            raise FormatError(path, f"truncated: the pixels end in row {y} of {header.height}") from None
        except _RunError:
            raise FormatError(path, f"damaged: a run crosses the end of row {y}") from None
        rows[y] = row.reshape(-1, 4)
    exponent = rows[..., 3:].astype(np.int32)
    factor = np.where(exponent > 0, np.ldexp(np.float32(1.0), exponent - 136), np.float32(0.0))
    with np.errstate(over="ignore"):  # an absurd exposure gives infinite values, which the caller counts
        return (rows[..., :3] * factor / header.exposure).astype(np.float32)


def _read_header(path: PathLike, data: bytes) -> _Header:
    end = data.find(b"\n\n", 0, _HEADER_BYTES_MAX)
    stop = data.find(b"\n", end + 2, end + 2 + _HEADER_BYTES_MAX)
    if end < 0 or stop < 0:
        raise FormatError(path, "truncated: the header of the HDR picture does not end")
    exposure = np.ones(3)
    for line in data[:end].decode("latin-1").splitlines():
        name, _, value = line.partition("=")
        if name == "FORMAT" and value.strip() != "32-bit_rle_rgbe":
            raise FormatError(path, f"has FORMAT {value.strip()[:40]!r}, expected 32-bit_rle_rgbe")
        if name in ("EXPOSURE", "COLORCORR"):
            factors = _positive_numbers(value)
            if len(factors) not in (1, 3):
                raise FormatError(path, f"has {name} {value.strip()[:40]!r}, expected a positive number")
            exposure = exposure * factors
    resolution = data[end + 2 : stop].decode("latin-1").strip()
    sizes = re.fullmatch(r"([+-][XY]) (\d{1,9}) ([+-][XY]) (\d{1,9})", resolution)
    if not sizes:
        raise FormatError(path, f"has the resolution {resolution[:40]!r}, expected '-Y height +X width'")
    if (sizes[1], sizes[3]) != ("-Y", "+X"):
        raise FormatError(path, f"is stored as '{resolution}', expected '-Y height +X width': turn the picture first")
    height, width = int(sizes[2]), int(sizes[4])
    if not width or not height:
        raise FormatError(path, f"has no pixels: {width} x {height}")
    return _Header(width, height, exposure, stop + 1)


def _positive_numbers(text: str) -> list[float]:
    """The numbers of a header line; empty if one is not a positive number."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return []
    return numbers if all(0.0 < number < math.inf for number in numbers) else []


class _RunError(Exception):
    """A run of the run-length encoding crosses the end of its row."""


def _read_row(data: bytes, at: int, width: int) -> tuple[npt.NDArray[np.uint8], int]:
    """The RGBE bytes of the row that begins at byte ``at``, and the byte at which the next row begins.

    Raises:
        IndexError: The data end before the row does.
        _RunError: A run crosses the end of the row.
    """
    encoded = data[at] == 2 == data[at + 1] and (data[at + 2] << 8 | data[at + 3]) == width
    if encoded and width in _ENCODED_WIDTHS:
        return _read_channels(data, at + 4, width)
    row = np.frombuffer(data[at : at + 4 * width], np.uint8)
    if row.size == 4 * width and not (row.reshape(-1, 4)[:, :3] == 1).all(axis=1).any():
        return row, at + 4 * width
    return _read_repeats(data, at, width)


def _read_channels(data: bytes, at: int, width: int) -> tuple[npt.NDArray[np.uint8], int]:
    """The newer encoding: one channel after the other, each in runs of equal bytes and runs of different bytes."""
    row = bytearray()
    for end in (width, 2 * width, 3 * width, 4 * width):
        while len(row) < end:
            count = data[at]
            if count > 128:
                row += data[at + 1 : at + 2] * (count - 128)
                at += 2
            else:
                row += data[at + 1 : at + 1 + count]
                at += 1 + count
        if len(row) > end:
            raise _RunError
    return np.frombuffer(bytes(row), np.uint8).reshape(4, width).T.reshape(-1), at


def _read_repeats(data: bytes, at: int, width: int) -> tuple[npt.NDArray[np.uint8], int]:
    """The older encoding: (1, 1, 1, n) repeats the last pixel n times; another one directly after it, 256 n times."""
    row, shift = bytearray(), 0
    while len(row) < 4 * width:
        pixel = data[at : at + 4]
        count = pixel[3]
        at += 4
        if pixel[:3] != b"\1\1\1":
            row += pixel
            shift = 0
        else:
            count <<= shift
            if not row or count > width:
                raise _RunError
            row += row[-4:] * count
            shift += 8
    if len(row) > 4 * width:
        raise _RunError
    return np.frombuffer(bytes(row), np.uint8), at
