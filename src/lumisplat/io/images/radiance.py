"""Reads radiance images (Radiance HDR or OpenEXR, recognised by content) and display-referred images.

Radiance HDR (.hdr, .pic) has RGBE pixels, uncompressed or in one of two run-length encodings.
"""

from __future__ import annotations

import logging
import math
import os
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, check_expansion, parsing, read_bytes
from lumisplat.io.images.exr import read_exr, write_exr
from lumisplat.io.images.texture import read_texture
from lumisplat.math.arrays import FloatArray
from lumisplat.math.color import encode_srgb

_log = logging.getLogger("lumisplat")

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_DISPLAY_IMAGES = {b"\x89PNG": "a PNG", b"\xff\xd8\xff": "a JPEG", b"RIFF": "a WebP", b"BM": "a BMP", b"GIF8": "a GIF"}

_MAGIC = b"#?"

_HEADER_BYTES_MAX = 2**16
_ENCODED_WIDTHS = range(8, 2**15)
"""Widths of Radiance HDR images whose rows may have the newer run-length encoding; other rows are stored unencoded."""

LINEAR = (".exr", ".hdr", ".pic")
"""Extensions of image files that hold linear radiance."""


_NOTICEABLE = 1e-3
"""Negative values are logged only if their sum exceeds this fraction of the image's sum. Ringing of filters stays
below it."""


def read_radiance(path: PathLike) -> FloatArray:
    """Reads linear radiance; see `lumisplat.io.load_radiance`."""
    data = read_bytes(path)
    with parsing(path, "an image of radiance (.hdr or .exr)"):
        if data.startswith(_MAGIC):
            image = decode_hdr(path, data)
        elif data.startswith(_EXR_MAGIC):
            image = _exr_colors(path)
        else:
            kinds = [kind for magic, kind in _DISPLAY_IMAGES.items() if data.startswith(magic)]
            found = f"{kinds[0]} image with 8 bits per channel" if kinds else "neither Radiance HDR nor OpenEXR"
            raise FormatError(path, f"is {found}, expected .hdr or .exr with linear radiance")
    return _without_invalid(path, image)


def write_radiance(path: PathLike, image: FloatArray) -> None:
    """Writes radiance, shape (H, W, 3), as an EXR that `read_radiance` reads.

    Raises:
        FormatError: The file cannot be written.
    """
    write_exr(path, {name: image[..., channel] for channel, name in enumerate("RGB")})


def _exr_colors(path: PathLike) -> FloatArray:
    """Reads the channels R, G and B of an EXR, shape (H, W, 3)."""
    channels = read_exr(path)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        listed = ", ".join(channels)[:80] or "none"
        raise FormatError(path, f"has no channel {' nor '.join(missing)}, only {listed}: expected R, G and B")
    planes = [channels[name] for name in "RGB"]
    if any(plane.dtype.kind != "f" for plane in planes) or len({plane.shape for plane in planes}) > 1:
        shapes = ", ".join(f"{plane.dtype} {plane.shape}" for plane in planes)
        raise FormatError(path, f"has R, G and B as {shapes}, expected half or float of one size")
    return np.stack(planes, axis=2, dtype=np.float32)


def _without_invalid(path: PathLike, image: FloatArray) -> FloatArray:
    """Replaces negative and non-finite values by 0, and logs their number. Returns a read-only image.

    Negative values are not logged if their sum is at most `_NOTICEABLE` of the image's sum.
    """
    not_finite = ~np.isfinite(image)
    with np.errstate(invalid="ignore"):
        negative = (image < 0.0) & ~not_finite
    if not_finite.any() or negative.any():
        lost = -image[negative].sum(dtype=np.float64)
        image = np.where(not_finite | negative, np.float32(0.0), image)
        is_noticeable = lost > _NOTICEABLE * image.sum(dtype=np.float64)
        counts = {"not finite": np.count_nonzero(not_finite), "negative": is_noticeable * np.count_nonzero(negative)}
        if listed := ", ".join(f"{count:,} {problem}" for problem, count in counts.items() if count):
            _log.warning("%s: values set to 0: %s", os.fspath(path), listed)
    image.flags.writeable = False
    return image


class _Header(NamedTuple):
    width: int
    height: int
    exposure: npt.NDArray[np.float64]
    """Divisor of the pixels, the product of the header's exposures and colour corrections, shape (3,)."""
    size: int
    """Length of the header, bytes."""


def decode_hdr(path: PathLike, data: bytes) -> npt.NDArray[np.float32]:
    """Decodes Radiance HDR to linear radiance, divided by the header's exposures, shape (H, W, 3), row 0 at the top.

    A mantissa m with exponent e is ``m 2^(e - 136)``, as in most readers; integers are thus exact.

    Args:
        path: File to name in errors.
        data: The whole file.

    Raises:
        FormatError: The file is damaged or truncated, has XYZ colours, or another order of rows and columns.
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
    with np.errstate(over="ignore"):  # huge exposures give infinite values, which the caller counts
        return (rows[..., :3] * factor / header.exposure).astype(np.float32)


def _read_header(path: PathLike, data: bytes) -> _Header:
    end = data.find(b"\n\n", 0, _HEADER_BYTES_MAX)
    stop = data.find(b"\n", end + 2, end + 2 + _HEADER_BYTES_MAX)
    if end < 0 or stop < 0:
        raise FormatError(path, "truncated: the HDR header does not end")
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
        raise FormatError(path, f"is stored as '{resolution}', expected '-Y height +X width': rotate the image first")
    height, width = int(sizes[2]), int(sizes[4])
    if not width or not height:
        raise FormatError(path, f"has no pixels: {width} x {height}")
    return _Header(width, height, exposure, stop + 1)


def _positive_numbers(text: str) -> list[float]:
    """Returns the numbers in a header line; an empty list unless all are positive numbers."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return []
    return numbers if all(0.0 < number < math.inf for number in numbers) else []


class _RunError(Exception):
    """A run of the run-length encoding is longer than the rest of its row."""


def _read_row(data: bytes, at: int, width: int) -> tuple[npt.NDArray[np.uint8], int]:
    """Decodes the row that begins at byte ``at``. Returns its RGBE bytes and the byte offset of the next row."""
    encoded = data[at] == 2 == data[at + 1] and (data[at + 2] << 8 | data[at + 3]) == width
    if encoded and width in _ENCODED_WIDTHS:
        return _read_channels(data, at + 4, width)
    row = np.frombuffer(data[at : at + 4 * width], np.uint8)
    if row.size == 4 * width and not (row.reshape(-1, 4)[:, :3] == 1).all(axis=1).any():
        return row, at + 4 * width
    return _read_repeats(data, at, width)


def _read_channels(data: bytes, at: int, width: int) -> tuple[npt.NDArray[np.uint8], int]:
    """Decodes the newer encoding: one channel after the other, as runs of equal bytes and runs of different bytes."""
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
    """Decodes the older encoding of a row, in which a pixel (1, 1, 1, n) repeats the pixel before it n times.

    A second such pixel in succession stands for 256 n further repeats.
    """
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


def read_display_image(path: PathLike) -> FloatArray:
    """Reads an image as display-referred values; see `lumisplat.io.load_image`."""
    if Path(path).suffix.lower() in LINEAR:
        return np.clip(encode_srgb(read_radiance(path)), 0.0, 1.0).astype(np.float32)
    pixels = read_texture(path).astype(np.float32) / np.float32(255.0)
    return pixels[..., :3] * pixels[..., 3:] if pixels.shape[2] == 4 else pixels
