"""Reads Niantic SPZ, versions 1 to 4, and writes version 4. Layout: https://github.com/nianticlabs/spz.

Versions 1 to 3 are a gzip stream of a 16-byte header and six packed sections (positions, alphas, colours, scales,
rotations, SH), followed by extension records. Version 4 compresses each section separately with Zstandard.
"""

from __future__ import annotations

import itertools
import json
import logging
import math
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import zstandard

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike, check_gaussian_count, read_bytes
from lumisplat.io.splats.columns import (
    Floats,
    SplatColumns,
    columns_from_gaussians,
    mirror_axes,
    pack_smallest_three,
    unpack_smallest_three,
    warn_losses,
)
from lumisplat.io.splats.orientation import UNSTATED, Orientation, orientation_of_text, orientation_values
from lumisplat.scene.gaussians import Gaussians

_log = logging.getLogger("lumisplat")

_MAGIC = 0x5053474E  # "NGSP"
_FLAG_ANTIALIASED = 0x1
_FLAG_EXTENSIONS = 0x2
_FRACTIONAL_BITS_MAX = 24
_HEADER = struct.Struct("<IIIBBBB")

_COLOR_SCALE = 0.15
"""Factor of a degree 0 SH coefficient c in a colour byte, 255 (0.5 + 0.15 c).

Bytes thus cover more than colours of 0..1, so that hardly any coefficient is clipped."""
_DC_MAX = 0.5 / _COLOR_SCALE
"""Largest magnitude of a DC coefficient that SPZ can store."""

_LOG_SCALE_MIN = -10.0
"""Smallest log scale that SPZ can store, as byte 0; the bytes above are 1/16 apart."""
_LOG_SCALE_MAX = _LOG_SCALE_MIN + 255.0 / 16.0
"""Largest log scale that SPZ can store."""

_SECTIONS = ("positions", "alphas", "colours", "scales", "rotations", "SH")

Bytes = npt.NDArray[np.uint8]

_EXTENSION_BYTES_MAX = 2**16
_GZIP_WINDOW = 16 + zlib.MAX_WBITS

_HEADER_V4 = struct.Struct("<IIIBBBBI12x")
"""Layout of the version 4 header: the fields of all versions, number of streams, and byte offset of the table of
stream sizes.
"""

_ZSTD_LEVEL = 12
"""Compression level of the zstd streams; see docs/adr/0064-spz-4-by-numpy-and-zstandard.md."""

_SIZE_UNKNOWN = -1
"""Size that the zstandard library reports for a stream whose header states no decompressed size."""

_EXTENSION_COORDINATES = 0xADBE0003
"""Number of the extension SPZ_ADOBE_coordinate_system, whose record is one u32 that names the axes."""

_EXTENSION_ORIENTATION = 0x4C530001
"""Number of Lumisplat's extension, whose record is up direction and first view as JSON, in Lumisplat's axes.

See `lumisplat.io.splats.orientation`. Other readers skip unknown extensions."""

_COORDINATES = ("RUB", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")
"""Directions of the x, y and z axes by the number in SPZ_ADOBE_coordinate_system; 0 is unspecified.

Letters mean right or left, up or down, back or front. Numbers 9 to 16 exchange y and z and are not supported."""


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """Fields of the SPZ header that versions 1 to 4 have."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    """Fractional bits of the fixed-point positions. Version 1 has floating-point positions instead."""
    flags: int

    @property
    def sh_coefficients(self) -> int:
        """Number of SH coefficients per channel, including DC."""
        return (self.sh_degree + 1) ** 2

    @property
    def section_sizes(self) -> tuple[int, int, int, int, int, int]:
        """Decompressed sizes in bytes of the six sections: positions, alphas, colours, scales, rotations and SH."""
        n = self.count
        position, rotation = (6 if self.version == 1 else 9), (4 if self.version >= 3 else 3)
        return position * n, n, 3 * n, 3 * n, rotation * n, 3 * (self.sh_coefficients - 1) * n


def _parse_spz_header(path: PathLike, data: bytes, versions: range, stored_bytes: int) -> SpzHeader:
    """Parses the header, and checks its Gaussian count against the size of the file.

    Args:
        path: File to name in errors.
        data: Bytes that begin with the header.
        versions: Versions that may use this container (gzip or version 4).
        stored_bytes: Size of the file.
    """
    if len(data) < _HEADER.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    magic, version, count, degree, fractional_bits, flags, _ = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise FormatError(path, "is not an SPZ file: no NGSP header")
    if version not in versions:
        raise FormatError(path, f"is SPZ version {version}, expected {versions[0]} to {versions[-1]} in this container")
    if degree > SH_DEGREE_MAX:
        raise FormatError(path, f"has SH degree {degree}, at most {SH_DEGREE_MAX} is supported")
    if version > 1 and not 1 <= fractional_bits <= _FRACTIONAL_BITS_MAX:
        raise FormatError(path, f"has {fractional_bits} fractional bits, expected 1 to {_FRACTIONAL_BITS_MAX}")
    header = SpzHeader(version, count, degree, fractional_bits, flags)
    check_gaussian_count(path, count, header.sh_coefficients, stored_bytes)
    return header


def _decode_sections(header: SpzHeader, sections: Sequence[Bytes]) -> SplatColumns:
    """Decodes the six sections of an SPZ file (positions, alphas, ...) to Gaussians, in the axes of the file.

    Args:
        header: Header of the file.
        sections: Bytes of each section in `_SECTIONS`, of the sizes that the header implies.
    """
    positions, alphas, colors, scales, rotations, sh = sections
    n = header.count
    coefficients = np.empty((n, header.sh_coefficients, 3), dtype=np.float32)
    coefficients[:, 0] = (colors.reshape(n, 3) / np.float32(255.0) - np.float32(0.5)) / np.float32(_COLOR_SCALE)
    coefficients[:, 1:] = (sh.reshape(n, -1, 3) - np.float32(128.0)) / np.float32(128.0)
    half = header.version == 1
    return SplatColumns(
        means=_half_positions(positions) if half else _fixed_positions(positions, header.fractional_bits),
        rotations_wxyz=_packed_rotations(rotations) if header.version >= 3 else _byte_rotations(rotations),
        log_scales=scales.reshape(n, 3) / np.float32(16.0) + np.float32(_LOG_SCALE_MIN),
        opacities=alphas / np.float32(255.0),
        sh=coefficients,
        opacities_are_logits=False,
    )


def _half_positions(section: Bytes) -> Floats:
    return section.view("<f2").astype(np.float32).reshape(-1, 3)


def _fixed_positions(section: Bytes, fractional_bits: int) -> Floats:
    """Decodes the positions of N Gaussians from 24-bit fixed-point numbers in two's complement, shape (N, 3)."""
    parts = section.reshape(-1, 3, 3).astype(np.int32)
    # Shifted to the high bytes of an int32 first, so that shifting back down extends the sign.
    fixed = (parts[..., 0] << 8 | parts[..., 1] << 16 | parts[..., 2] << 24) >> 8
    return fixed * np.float32(2.0**-fractional_bits)


def _byte_rotations(section: Bytes) -> Floats:
    """Decodes N quaternions wxyz, shape (N, 4), from x, y and z as bytes; w >= 0 follows from the unit length."""
    xyz = section.reshape(-1, 3) / np.float32(127.5) - np.float32(1.0)
    return unpack_smallest_three(np.zeros(len(xyz), dtype=np.int64), xyz)


def _packed_rotations(section: Bytes) -> Floats:
    """Decodes N quaternions wxyz, shape (N, 4), from their three smallest components, stored in the order xyzw.

    A 32-bit word has a 2-bit index of the largest component, then three times a sign bit and a 9-bit magnitude.
    """
    packed = section.view("<u4")
    fields = np.stack([packed >> np.uint32(shift) & np.uint32(0x3FF) for shift in (20, 10, 0)], axis=1)
    magnitude = (fields & np.uint32(0x1FF)) * np.float32(np.sqrt(0.5) / 511.0)
    smallest = np.where(fields >> np.uint32(9), -magnitude, magnitude).astype(np.float32)
    return np.roll(unpack_smallest_three(packed >> np.uint32(30), smallest), 1, axis=1)


def _encode_sections(columns: SplatColumns, fractional_bits: int) -> list[bytes]:
    """Encodes the sections of versions 3 and 4; each value is rounded to the nearest one that SPZ can store.

    Args:
        columns: Gaussians in the axes of the file, with unit rotations and opacities in 0..1.
        fractional_bits: Fractional bits of the positions, few enough that all positions fit into 24 bits.

    Returns:
        Bytes of each section in `_SECTIONS`; the SH section is empty if the Gaussians have only degree 0.
    """
    # Clamped because the largest coordinate that fits may round up to one that does not.
    fixed = np.clip(np.floor(columns.means * np.float64(2.0**fractional_bits) + 0.5), -(2**23), 2**23 - 1).astype("<i4")
    return [
        np.ascontiguousarray(fixed[..., None].view(np.uint8)[..., :3]).tobytes(),
        _rounded(255.0 * columns.opacities),
        _rounded(255.0 * (0.5 + _COLOR_SCALE * columns.sh[:, 0].astype(np.float64))),
        _rounded(16.0 * (columns.log_scales.astype(np.float64) - _LOG_SCALE_MIN)),
        _pack_rotations(columns.rotations_wxyz).tobytes(),
        _rounded(128.0 * columns.sh[:, 1:] + 128.0),
    ]


def _rounded(values: Floats) -> bytes:
    """Rounds values to bytes, clamped to 0..255."""
    return np.clip(np.floor(values + 0.5), 0, 255).astype(np.uint8).tobytes()


def _pack_rotations(wxyz: Floats) -> npt.NDArray[np.uint32]:
    """Encodes quaternions wxyz, the inverse of `_packed_rotations`."""
    largest, smallest = pack_smallest_three(np.roll(wxyz, -1, axis=1))
    packed = largest.astype("<u4")
    for component in smallest.T:
        magnitude = np.minimum(np.floor(np.abs(component) * (511.0 * np.sqrt(2.0)) + 0.5), 511.0).astype("<u4")
        packed = packed << np.uint32(10) | (component < 0.0).astype("<u4") << np.uint32(9) | magnitude
    return packed


def _read_legacy(path: PathLike, data: bytes) -> tuple[SpzHeader, SplatColumns, bytes]:
    """Decodes a gzip container, versions 1 to 3.

    Args:
        path: File to name in errors.
        data: The whole file.

    Returns:
        Header, Gaussians in the axes of the file, and the bytes of extension records.
    """
    header = _parse_spz_header(path, _inflate(path, data, _HEADER.size), range(1, 4), len(data))
    size = sum(header.section_sizes)
    # Decompresses at most the size that the header implies, however long the stream is.
    content = _inflate(path, data, _HEADER.size + size + _EXTENSION_BYTES_MAX)
    if len(content) < _HEADER.size + size:
        raise FormatError(
            path,
            f"truncated: {header.count:,} Gaussians take {size:,} bytes, but it has {len(content) - _HEADER.size:,}",
        )
    ends = np.cumsum((_HEADER.size, *header.section_sizes))
    sections = [np.frombuffer(content, np.uint8)[a:b] for a, b in itertools.pairwise(ends)]
    return header, _decode_sections(header, sections), content[ends[-1] :]


def _inflate(path: PathLike, data: bytes, size: int) -> bytes:
    """Decompresses the first ``size`` bytes of a gzip stream, or the whole stream if it is shorter."""
    try:
        return zlib.decompressobj(_GZIP_WINDOW).decompress(data, size)
    except zlib.error as error:
        raise FormatError(path, f"damaged: {error}") from None


@np.errstate(all="ignore")  # signalling NaN of version 1 is refused later
def read_spz(path: PathLike) -> SplatColumns:
    """Reads an SPZ file of any version.

    Raises:
        FormatError: The file is not SPZ, damaged, truncated, of an unknown version, or has an SH degree above 3.
    """
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        header, columns, extensions = _read_legacy(path, data)
    elif data[:4] == b"NGSP":
        header, columns, extensions = _read_v4(path, data)
    else:
        raise FormatError(path, "is not an SPZ file: neither gzip nor NGSP at its start")
    records = dict(_records(extensions)) if header.flags & _FLAG_EXTENSIONS else {}
    columns = mirror_axes(columns, _rdf_signs(_stored_axes(path, records)))
    columns.antialiased = bool(header.flags & _FLAG_ANTIALIASED)
    columns.orientation = _stored_orientation(path, records)
    return columns


def read_spz_orientation(path: PathLike) -> Orientation:
    """Reads the up direction and the first view without the Gaussians.

    Both are None for versions 1 to 3, which Lumisplat never writes.

    Raises:
        FormatError: The file is damaged.
    """
    data = read_bytes(path)
    if data[:4] != b"NGSP" or len(data) < _HEADER_V4.size:
        return UNSTATED
    header = _parse_spz_header(path, data, range(4, 5), len(data))
    records = _records(data[_HEADER_V4.size : _HEADER_V4.unpack_from(data)[-1]])
    return _stored_orientation(path, dict(records) if header.flags & _FLAG_EXTENSIONS else {})


def _read_v4(path: PathLike, data: bytes) -> tuple[SpzHeader, SplatColumns, bytes]:
    """Decodes version 4. Returns header, Gaussians in the axes of the file, and extension records as bytes."""
    header = _parse_spz_header(path, data, range(4, 5), len(data))
    if len(data) < _HEADER_V4.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    *_, stream_count, toc_offset = _HEADER_V4.unpack_from(data)
    sizes = [size for size in header.section_sizes if size]
    toc_end = toc_offset + 16 * len(sizes)
    if stream_count != len(sizes) or toc_offset < _HEADER_V4.size:
        raise FormatError(path, f"damaged: has {stream_count} streams at byte {toc_offset}, expected {len(sizes)}")
    if toc_end > len(data):
        raise FormatError(path, "truncated: the table of contents is incomplete")
    toc = np.frombuffer(data, "<u8", 2 * len(sizes), toc_offset).reshape(-1, 2).tolist()
    if [unpacked for _, unpacked in toc] != sizes:
        raise FormatError(path, f"damaged: its streams do not hold {header.count:,} Gaussians")
    ends = list(itertools.accumulate((packed for packed, _ in toc), initial=toc_end))
    if ends[-1] > len(data):
        raise FormatError(path, f"truncated: {len(data):,} bytes are fewer than its table of contents promises")
    streams = [data[start:end] for start, end in itertools.pairwise(ends)]
    sections = [_unpacked(path, *stream) for stream in zip(_SECTIONS, streams, sizes, strict=False)]
    sections += [np.empty(0, np.uint8)] * (len(_SECTIONS) - len(sections))  # there is no stream of SH at degree 0
    return header, _decode_sections(header, sections), data[_HEADER_V4.size : toc_offset]


def _unpacked(path: PathLike, name: str, stream: bytes, size: int) -> npt.NDArray[np.uint8]:
    """Decompresses the zstd stream of the section ``name``, which must give exactly ``size`` bytes and never more."""
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


def _rdf_signs(axes: str) -> tuple[int, int, int]:
    """Returns the signs of x, y and z that convert axes such as ``"RUB"`` (right, up, back) to right, down, front."""
    x, y, z = axes
    return (1 if x == "R" else -1, 1 if y == "D" else -1, 1 if z == "F" else -1)


def _records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields the extension number and the contents of each extension record; the last record may be truncated."""
    start = 0
    while start + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        yield kind, extensions[start + 8 : start + 8 + size]
        start += 8 + size


def _stored_axes(path: PathLike, records: dict[int, bytes]) -> str:
    """Returns the axes of the file as letters; the default is ``"RUB"``, x to the right, y up, z to the back.

    ``records`` has the contents of extension records by extension number.
    """
    stored = records.get(_EXTENSION_COORDINATES, b"")
    if len(stored) != 4:
        return "RUB"
    (coordinates,) = struct.unpack("<I", stored)
    if coordinates >= len(_COORDINATES):
        raise FormatError(path, f"its axes (SPZ_ADOBE_coordinate_system {coordinates}) are not supported")
    return _COORDINATES[coordinates]


def _stored_orientation(path: PathLike, records: dict[int, bytes]) -> Orientation:
    """Returns the up direction and first view in Lumisplat's extension record; both None without such a record.

    ``records`` has the contents of extension records by extension number.
    """
    return orientation_of_text(path, records.get(_EXTENSION_ORIENTATION, b"{}"))


def write_spz(path: PathLike, gaussians: Gaussians) -> None:
    """Writes SPZ version 4, with x to the right, y up and z to the back (RUB).

    Values are quantised: positions in steps of `position_bits`, log scales to 1/16 within -10..5.94, opacities to 8
    bits, DC to 8 bits within +-3.33, other SH to 8 bits within -1..1, rotations to 10 bits per component. Values
    outside these ranges are clamped, and a warning counts the Gaussians with such values.

    Raises:
        FormatError: A position does not fit into 24-bit fixed point, or the file cannot be written.
    """
    warn_losses(path, "SPZ", gaussians)
    columns = replace(columns_from_gaussians(gaussians), opacities=gaussians.opacities, opacities_are_logits=False)
    columns = mirror_axes(columns, _rdf_signs("RUB"))
    _warn_clamped(path, columns)
    bits = position_bits(path, float(np.abs(columns.means).max()))
    sections = [section for section in _encode_sections(columns, bits) if section]
    pack = zstandard.ZstdCompressor(level=_ZSTD_LEVEL, write_checksum=True).compress
    streams = [pack(section) for section in sections]
    toc = [(len(stream), len(section)) for stream, section in zip(streams, sections, strict=True)]
    flags = _FLAG_ANTIALIASED if gaussians.antialiased else 0
    degree = gaussians.sh_degree
    record = b""
    if stated := orientation_values(gaussians.up, gaussians.first_view):
        text = json.dumps(stated).encode()
        record = struct.pack("<II", _EXTENSION_ORIENTATION, len(text)) + text
        flags |= _FLAG_EXTENSIONS
    table = _HEADER_V4.size + len(record)
    header = _HEADER_V4.pack(_MAGIC, 4, columns.count, degree, bits, flags, len(streams), table)
    with atomic_write(path) as temporary:
        temporary.write_bytes(b"".join([header, record, np.array(toc, "<u8").tobytes(), *streams]))


def _warn_clamped(path: PathLike, columns: SplatColumns) -> None:
    """Logs how many Gaussians have scales or SH coefficients outside the range of SPZ."""
    least, most = f"{math.exp(_LOG_SCALE_MIN):.2g}", f"{math.exp(_LOG_SCALE_MAX):.3g}"
    remedy = "clipped, save as .ply to keep them"
    clamped = (
        (columns.log_scales < _LOG_SCALE_MIN, f"have scales below {least}, the smallest of SPZ: enlarged"),
        (columns.log_scales > _LOG_SCALE_MAX, f"have scales above {most}, the largest of SPZ: reduced"),
        (np.abs(columns.sh[:, :1]) > _DC_MAX, f"have a colour too bright or too dark for SPZ: {remedy}"),
        (np.abs(columns.sh[:, 1:]) > 1.0, f"have SH coefficients outside -1..1, the range of SPZ: {remedy}"),
    )
    for beyond, problem in clamped:
        count = np.count_nonzero(beyond.reshape(columns.count, -1).any(axis=1))
        if count:
            _log.warning("%s: %s of %s Gaussians %s", os.fspath(path), f"{count:,}", f"{columns.count:,}", problem)


def position_bits(path: PathLike, largest: float) -> int:
    """Returns the fractional bits of the 24-bit positions: usually 12, more for small scenes, fewer for large ones.

    Positions have steps of 2^-bits scene units. 12 bits reach 2048 units but are too coarse for small objects, so a
    scene below 32 units gets steps of at most 2^-17 of its largest coordinate.

    Args:
        path: File to name in the error.
        largest: Largest magnitude of a coordinate, scene units.

    Raises:
        FormatError: The largest coordinate does not fit with any number of bits.
    """
    fitting = 22 - math.floor(math.log2(largest)) if largest > 0.0 else _FRACTIONAL_BITS_MAX
    if fitting < 1:
        raise FormatError(path, f"a position of {largest:g} is beyond {2**22:,}, the largest of SPZ: scale the scene")
    return min(fitting, max(12, fitting - 5), _FRACTIONAL_BITS_MAX)
