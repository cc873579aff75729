"""Niantic SPZ, versions 1 to 4.

Versions 1 to 3 are one gzip stream, decoded by `spz_legacy`. Version 4 is a plain header, a table of contents and one
zstd stream per attribute. SPZ has RUB axes (x right, y up, z back) unless an extension names others; ours are those of
the usual PLY (x right, y down, z forward), so that y and z are mirrored on load and on save.
Layout: https://github.com/nianticlabs/spz.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import os
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import zstandard

from lumisplat.constants import KERNEL_DEGREE
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, read_bytes
from lumisplat.io.splats.axes import mirror_axes
from lumisplat.io.splats.columns import SplatColumns, columns_from_gaussians, warn_lost_materials
from lumisplat.io.splats.orientation import UNSTATED, Orientation, orientation_of_text, orientation_values
from lumisplat.io.splats.spz_header import (
    FLAG_ANTIALIASED,
    FLAG_EXTENSIONS,
    FRACTIONAL_BITS_MAX,
    MAGIC,
    SpzHeader,
    parse_spz_header,
)
from lumisplat.io.splats.spz_legacy import read_legacy
from lumisplat.io.splats.spz_sections import (
    DC_MAX,
    LOG_SCALE_MAX,
    LOG_SCALE_MIN,
    SECTIONS,
    decode_sections,
    encode_sections,
)
from lumisplat.scene.gaussians import Gaussians

_log = logging.getLogger("lumisplat")

HEADER_V4 = struct.Struct("<IIIBBBBI12x")
"""The fields of all versions, the last of which is the number of streams, then the offset of the table of contents."""

ZSTD_LEVEL = 12
"""Level of the zstd streams, see docs/adr/0064-spz-by-numpy-and-zstandard.md."""

_SIZE_UNKNOWN = -1
"""What zstandard says of streams whose writer did not know their size when it began."""

EXTENSION_COORDINATES = 0xADBE0003
"""Extension SPZ_ADOBE_coordinate_system: one u32 that names the axes."""

EXTENSION_ORIENTATION = 0x4C530001
"""Our own extension: up and first view as JSON (`lumisplat.io.splats.orientation`), in our axes. Others skip it."""

COORDINATES = ("RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
"""Axes by that number: right or left, up or down, back or front; 0 is unspecified. Numbers 9 to 16 exchange y and z and
are not supported."""


@np.errstate(all="ignore")  # NaN that signals, of version 1, is refused later
def read_spz(path: PathLike) -> SplatColumns:
    """Reads an SPZ file of any version.

    Raises:
        FormatError: The file is not SPZ, damaged, truncated, of an unknown version, or has an SH degree above 3.
    """
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        header, columns, extensions = read_legacy(path, data)
    elif data[:4] == b"NGSP":
        header, columns, extensions = _read_v4(path, data)
    else:
        raise FormatError(path, "is not an SPZ file: neither gzip nor NGSP at its start")
    records = dict(_records(extensions)) if header.flags & FLAG_EXTENSIONS else {}
    columns = mirror_axes(columns, rdf_signs(_stored_axes(path, records)))
    columns.antialiased = bool(header.flags & FLAG_ANTIALIASED)
    columns.orientation = _stored_orientation(path, records)
    return columns


def read_spz_orientation(path: PathLike) -> Orientation:
    """Reads up and first view alone; those of versions before 4, which we never write, are not looked for.

    Raises:
        FormatError: The file is damaged.
    """
    data = read_bytes(path)
    if data[:4] != b"NGSP" or len(data) < HEADER_V4.size:
        return UNSTATED
    header = parse_spz_header(path, data, range(4, 5), len(data))
    records = _records(data[HEADER_V4.size : HEADER_V4.unpack_from(data)[-1]])
    return _stored_orientation(path, dict(records) if header.flags & FLAG_EXTENSIONS else {})


def _read_v4(path: PathLike, data: bytes) -> tuple[SpzHeader, SplatColumns, bytes]:
    """Header, Gaussians in the axes of the file, and the bytes of extension records."""
    header = parse_spz_header(path, data, range(4, 5), len(data))
    if len(data) < HEADER_V4.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    *_, stream_count, toc_offset = HEADER_V4.unpack_from(data)
    sizes = [size for size in header.section_sizes if size]
    toc_end = toc_offset + 16 * len(sizes)
    if stream_count != len(sizes) or toc_offset < HEADER_V4.size:
        raise FormatError(path, f"damaged: {stream_count} streams at byte {toc_offset}, expected {len(sizes)}")
    if toc_end > len(data):
        raise FormatError(path, "truncated: the table of contents is incomplete")
    toc = np.frombuffer(data, "<u8", 2 * len(sizes), toc_offset).reshape(-1, 2).tolist()
    if [unpacked for _, unpacked in toc] != sizes:
        raise FormatError(path, f"damaged: its streams do not hold {header.count:,} Gaussians")
    ends = list(itertools.accumulate((packed for packed, _ in toc), initial=toc_end))
    if ends[-1] > len(data):
        raise FormatError(path, f"truncated: {len(data):,} bytes are fewer than its table of contents promises")
    streams = [data[start:end] for start, end in itertools.pairwise(ends)]
    sections = [_unpacked(path, *stream) for stream in zip(SECTIONS, streams, sizes, strict=False)]
    sections += [np.empty(0, np.uint8)] * (len(SECTIONS) - len(sections))  # there is no stream of SH at degree 0
    return header, decode_sections(header, sections), data[HEADER_V4.size : toc_offset]


def _unpacked(path: PathLike, name: str, stream: bytes, size: int) -> npt.NDArray[np.uint8]:
    """The bytes of a zstd stream that holds ``size`` of them; no more is unpacked, however long it is."""
    try:
        stated = zstandard.frame_content_size(stream)
        if stated not in (size, _SIZE_UNKNOWN):
            raise FormatError(path, f"damaged: its {name} unpack to {stated:,} bytes, expected {size:,}")
        content = zstandard.ZstdDecompressor().decompress(stream, max_output_size=size)
    except zstandard.ZstdError as error:
        raise FormatError(path, f"damaged: its {name} cannot be unpacked: {error}") from None
    if len(content) != size:
        raise FormatError(path, f"truncated: its {name} unpack to {len(content):,} bytes, expected {size:,}")
    return np.frombuffer(content, np.uint8)


def rdf_signs(axes: str) -> tuple[int, int, int]:
    """Signs of x, y and z that convert right/left, up/down, back/front axes, such as ``"RUB"``, to ours."""
    x, y, z = axes
    return (1 if x == "R" else -1, 1 if y == "D" else -1, 1 if z == "F" else -1)


def _records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Extension records: their kinds and what they hold; the last may be cut off."""
    start = 0
    while start + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        yield kind, extensions[start + 8 : start + 8 + size]
        start += 8 + size


def _stored_axes(path: PathLike, records: dict[int, bytes]) -> str:
    """The axes that an extension record names, RUB if none does."""
    stored = records.get(EXTENSION_COORDINATES, b"")
    if len(stored) != 4:
        return "RUB"
    (coordinates,) = struct.unpack("<I", stored)
    if coordinates >= len(COORDINATES):
        raise FormatError(path, f"its axes (SPZ_ADOBE_coordinate_system {coordinates}) are not supported")
    return COORDINATES[coordinates]


def _stored_orientation(path: PathLike, records: dict[int, bytes]) -> Orientation:
    """Up and first view, of our own extension record."""
    return orientation_of_text(path, records.get(EXTENSION_ORIENTATION, b"{}"))


def write_spz(path: PathLike, gaussians: Gaussians) -> None:
    """Writes SPZ version 4 in RUB axes.

    Values are quantised: positions by `position_bits`, log scales to 1/16 within -10..5.94, opacities to 8 bits, DC to
    8 bits within +-3.33, other SH to 8 bits within -1..1, rotations to 10 bits per component. Gaussians of which
    anything is outside are counted in a warning, and clamped.

    Raises:
        FormatError: A position does not fit into 24-bit fixed point, or the file cannot be written.
    """
    warn_lost_materials(path, "SPZ", gaussians)
    if gaussians.kernel_degree != KERNEL_DEGREE:
        _log.warning(
            "%s: SPZ cannot store the kernel degree, %s: left out, save as .ply to keep it",
            os.fspath(path),
            gaussians.kernel_degree,
        )
    columns = replace(columns_from_gaussians(gaussians), opacities=gaussians.opacities, opacities_are_logits=False)
    columns = mirror_axes(columns, rdf_signs("RUB"))
    _warn_clamped(path, columns)
    bits = position_bits(path, float(np.abs(columns.means).max()))
    sections = [section for section in encode_sections(columns, bits) if section]
    pack = zstandard.ZstdCompressor(level=ZSTD_LEVEL, write_checksum=True).compress
    streams = [pack(section) for section in sections]
    toc = [(len(stream), len(section)) for stream, section in zip(streams, sections, strict=True)]
    flags = FLAG_ANTIALIASED if gaussians.antialiased else 0
    degree = gaussians.sh_degree
    record = b""
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        text = json.dumps(stated).encode()
        record = struct.pack("<II", EXTENSION_ORIENTATION, len(text)) + text
        flags |= FLAG_EXTENSIONS
    table = HEADER_V4.size + len(record)
    header = HEADER_V4.pack(MAGIC, 4, columns.count, degree, bits, flags, len(streams), table)
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"".join([header, record, np.array(toc, "<u8").tobytes(), *streams]))


def _warn_clamped(path: PathLike, columns: SplatColumns) -> None:
    """Says of how many Gaussians a file keeps less than they have."""
    least, most = f"{math.exp(LOG_SCALE_MIN):.2g}", f"{math.exp(LOG_SCALE_MAX):.3g}"
    kept = "clipped, save as .ply to keep them"
    clamped = (
        (columns.log_scales < LOG_SCALE_MIN, f"are thinner than {least}, where SPZ ends: widened"),
        (columns.log_scales > LOG_SCALE_MAX, f"are wider than {most}, where SPZ ends: narrowed"),
        (np.abs(columns.sh[:, :1]) > DC_MAX, f"have a colour too bright or too dark for SPZ: {kept}"),
        (np.abs(columns.sh[:, 1:]) > 1.0, f"have SH coefficients beyond -1..1, where SPZ ends: {kept}"),
    )
    for beyond, what in clamped:
        count = np.count_nonzero(beyond.reshape(columns.count, -1).any(axis=1))
        if count:
            _log.warning("%s: %s Gaussians %s", os.fspath(path), count, what)


def position_bits(path: PathLike, largest: float) -> int:
    """Fractional bits of the 24-bit positions: usually 12, more for small scenes, fewer for large ones.

    A step is 2^-bits scene units. 12 bits reach 2048 units, but are too coarse for small objects: a scene below 32
    units gets steps of at most 2^-17 of its largest coordinate.

    Raises:
        FormatError: The largest coordinate does not fit with any number of bits.
    """
    fitting = 22 - math.floor(math.log2(largest)) if largest > 0.0 else FRACTIONAL_BITS_MAX
    if fitting < 1:
        raise FormatError(path, f"a position of {largest:g} does not fit SPZ, which ends at {2**22:,}: scale the scene")
    return min(fitting, max(12, fitting - 5), FRACTIONAL_BITS_MAX)
