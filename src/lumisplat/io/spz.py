"""Niantic SPZ, versions 1 to 4.

Versions 1 to 3 are one gzip stream, decoded here (see `spz_legacy`). Version 4 is a plain header, a table of contents
and one zstd stream an attribute, decoded and written by the C++ module of gsply. SPZ holds RUB axes (x right, y up,
z back) unless an extension says otherwise; ours are those of the usual PLY (x right, y down, z forward), so y and z
are mirrored on load and on save. Layout: https://github.com/nianticlabs/spz.
"""

from __future__ import annotations

import math
import os
import struct
from dataclasses import dataclass, replace
from types import ModuleType

import numpy as np

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.atomic import atomic_write
from lumisplat.io.axes import mirrored
from lumisplat.io.columns import SplatColumns, columns_from_gaussians, warn_lost_materials
from lumisplat.io.limits import check_gaussian_count
from lumisplat.io.source import read_bytes
from lumisplat.scene.gaussians import Gaussians

MAGIC = 0x5053474E  # "NGSP"
FLAG_ANTIALIASED = 0x1
FLAG_EXTENSIONS = 0x2
FLAGS_OFFSET = 14
HEADER_V4 = struct.Struct("<IIIBBBBI12x")
HEADER_LEGACY = struct.Struct("<IIIBBBB")
FRACTIONAL_BITS_MAX = 24
EXTENSION_COORDINATES = 0xADBE0003
"""SPZ_ADOBE_coordinate_system: one u32 names the axes."""

RDF_FROM_RUB = (1, -1, -1)
RDF_FROM_COORDINATES = {
    index: (1 if index % 2 == 0 else -1, 1 if (index - 1) // 2 % 2 == 0 else -1, 1 if index > 4 else -1)
    for index in range(1, 9)
} | {0: RDF_FROM_RUB}
"""Signs that bring the axes named by that extension to ours. 1 to 8 count LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF;
0 is unspecified. 9 to 16 exchange y and z, and are not supported."""


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """What every version states up front."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    @property
    def sh_coefficients(self) -> int:
        """Per channel, DC included."""
        return (self.sh_degree + 1) ** 2

    @property
    def section_sizes(self) -> tuple[int, int, int, int, int, int]:
        """Bytes of positions, alphas, colours, scales, rotations and SH."""
        n = self.count
        position, rotation = (6 if self.version == 1 else 9), (4 if self.version >= 3 else 3)
        return position * n, n, 3 * n, 3 * n, rotation * n, 3 * (self.sh_coefficients - 1) * n


def read_spz(path: str | os.PathLike[str]) -> SplatColumns:
    """Reads an SPZ file of any version.

    Raises:
        FormatError: Not an SPZ file, damaged, truncated, of an unknown version or above SH degree 3.
    """
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        from lumisplat.io.spz_legacy import read_legacy

        header, columns, extensions = read_legacy(path, data)
    elif data[:4] == b"NGSP":
        header, columns, extensions = _read_v4(path, data)
    else:
        raise FormatError(path, "is not an SPZ file: neither gzip nor NGSP at its start")
    signs = _axis_signs(path, extensions) if header.flags & FLAG_EXTENSIONS else RDF_FROM_RUB
    return replace(mirrored(columns, signs), antialiased=bool(header.flags & FLAG_ANTIALIASED))


def parse_header(path: str | os.PathLike[str], data: bytes, versions: range, stored_bytes: int) -> SpzHeader:
    """The header at the start of ``data``, its count checked against what the file can hold.

    Args:
        path: Named in errors.
        data: At least the 16 bytes that all versions share.
        versions: Those that this container may hold.
        stored_bytes: Size of the file.

    Raises:
        FormatError: A field is out of its range.
    """
    if len(data) < HEADER_LEGACY.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    magic, version, count, degree, fractional_bits, flags, _ = HEADER_LEGACY.unpack_from(data)
    if magic != MAGIC:
        raise FormatError(path, "is not an SPZ file: no NGSP header")
    if version not in versions:
        raise FormatError(path, f"is SPZ version {version}, expected {versions[0]} to {versions[-1]} in this container")
    if degree > SH_DEGREE_MAX:
        raise FormatError(path, f"has SH degree {degree}, at most {SH_DEGREE_MAX} is supported")
    if version > 1 and not 1 <= fractional_bits <= FRACTIONAL_BITS_MAX:
        raise FormatError(path, f"has {fractional_bits} fractional bits, expected 1 to {FRACTIONAL_BITS_MAX}")
    check_gaussian_count(path, count, (degree + 1) ** 2, stored_bytes)
    return SpzHeader(version, count, degree, fractional_bits, flags)


def _read_v4(path: str | os.PathLike[str], data: bytes) -> tuple[SpzHeader, SplatColumns, bytes]:
    header = parse_header(path, data, range(4, 5), len(data))
    if len(data) < HEADER_V4.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    stream_count, toc_offset = HEADER_V4.unpack_from(data)[6:8]
    sizes = [size for size in header.section_sizes if size]
    toc_end = toc_offset + 16 * len(sizes)
    if stream_count != len(sizes) or toc_offset < HEADER_V4.size:
        raise FormatError(path, f"damaged: {stream_count} streams at byte {toc_offset}, expected {len(sizes)}")
    if toc_end > len(data):
        raise FormatError(path, "truncated: the table of contents is incomplete")
    toc = np.frombuffer(data, "<u8", 2 * len(sizes), toc_offset).reshape(-1, 2).tolist()
    if [unpacked for _, unpacked in toc] != sizes:
        raise FormatError(path, f"damaged: its streams do not hold {header.count:,} Gaussians")
    if toc_end + sum(packed for packed, _ in toc) > len(data):
        raise FormatError(path, f"truncated: {len(data):,} bytes are fewer than its table of contents promises")
    try:
        values = _gsply(path).read_spz(os.fspath(path))
    except RuntimeError as error:
        raise FormatError(path, f"damaged: {str(error).split(':')[0]}") from None
    sh = values["sh0"][:, None, :]
    if values["shN"] is not None:
        sh = np.concatenate([sh, values["shN"]], axis=1)
    columns = SplatColumns(values["means"], values["quats"], values["scales"], values["opacities"], sh)
    return header, columns, data[HEADER_V4.size : toc_offset]


def _gsply(path: str | os.PathLike[str]) -> ModuleType:
    # Imported by itself: `import gsply` would start numba, half a second that this module does not need.
    try:
        import gsply_cpp
    except ImportError:
        raise FormatError(
            path, "SPZ version 4 needs the C++ module in gsply's wheels: pip install --only-binary gsply gsply"
        ) from None
    return gsply_cpp


def _axis_signs(path: str | os.PathLike[str], extensions: bytes) -> tuple[int, int, int]:
    """Signs that bring the axes that the extension records state, RUB if none does, to ours."""
    start = 0
    while start + 8 <= len(extensions):
        kind, size = struct.unpack_from("<II", extensions, start)
        if kind == EXTENSION_COORDINATES and size == 4 and start + 12 <= len(extensions):
            (coordinates,) = struct.unpack_from("<I", extensions, start + 8)
            if coordinates not in RDF_FROM_COORDINATES:
                raise FormatError(path, f"its axes (SPZ_ADOBE_coordinate_system {coordinates}) are not supported")
            return RDF_FROM_COORDINATES[coordinates]
        start += 8 + size
    return RDF_FROM_RUB


def write_spz(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Writes SPZ version 4 in RUB axes.

    Quantised: positions as `position_bits` says, log scales to 1/16 within -10..5.94, colours and SH to 8 bits,
    rotations to 10 bits a component.

    Raises:
        FormatError: Positions beyond what 24-bit fixed point can hold, or the file cannot be written.
    """
    warn_lost_materials(path, "SPZ", gaussians)
    columns = mirrored(columns_from_gaussians(gaussians), RDF_FROM_RUB)
    bits = position_bits(path, float(np.abs(columns.means).max()))
    arrays = (columns.means, columns.log_scales, columns.rotations_wxyz, columns.opacities, columns.sh[:, 0])
    rest = np.ascontiguousarray(columns.sh[:, 1:]) if columns.sh.shape[1] > 1 else None
    gsply = _gsply(path)
    with atomic_write(path) as temporary:
        try:
            gsply.write_spz(str(temporary), *map(np.ascontiguousarray, arrays), rest, fractional_bits=bits, version=4)
        except RuntimeError as error:
            raise FormatError(path, f"cannot be written: {str(error).split(':')[0]}") from None
        if gaussians.antialiased:  # gsply leaves the flags at zero
            with temporary.open("r+b") as file:
                file.seek(FLAGS_OFFSET)
                file.write(bytes([FLAG_ANTIALIASED]))


def position_bits(path: str | os.PathLike[str], largest: float) -> int:
    """Fractional bits of the 24-bit positions: 12 as everywhere, more for small scenes, fewer for large ones.

    A step is 2^-bits scene units. 12 bits reach 2048 units; a scene below 32 units gets steps of at most 2^-17 of its
    largest coordinate, as 12 bits would be too coarse for a small object.

    Raises:
        FormatError: The largest coordinate fits no number of bits.
    """
    fitting = 22 - math.floor(math.log2(largest)) if largest > 0.0 else FRACTIONAL_BITS_MAX
    if fitting < 1:
        raise FormatError(path, f"a position of {largest:g} does not fit SPZ, which ends at {2**22:,}: scale the scene")
    return min(fitting, max(12, fitting - 5), FRACTIONAL_BITS_MAX)
