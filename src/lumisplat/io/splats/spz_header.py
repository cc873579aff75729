"""The header fields of all SPZ versions. Layout: https://github.com/nianticlabs/spz."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from lumisplat.constants import SH_DEGREE_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.limits import check_gaussian_count
from lumisplat.io.files.source import PathLike

MAGIC = 0x5053474E  # "NGSP"
FLAG_ANTIALIASED = 0x1
FLAG_EXTENSIONS = 0x2
FRACTIONAL_BITS_MAX = 24
HEADER = struct.Struct("<IIIBBBB")


@dataclass(frozen=True, slots=True)
class SpzHeader:
    """The fields that all versions have."""

    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    """Fractional bits of the fixed-point positions; version 1 has floating-point positions."""
    flags: int

    @property
    def sh_coefficients(self) -> int:
        """Number of SH coefficients per channel, including DC."""
        return (self.sh_degree + 1) ** 2

    @property
    def section_sizes(self) -> tuple[int, int, int, int, int, int]:
        """Bytes of positions, alphas, colours, scales, rotations and SH."""
        n = self.count
        position, rotation = (6 if self.version == 1 else 9), (4 if self.version >= 3 else 3)
        return position * n, n, 3 * n, 3 * n, rotation * n, 3 * (self.sh_coefficients - 1) * n


def parse_spz_header(path: PathLike, data: bytes, versions: range, stored_bytes: int) -> SpzHeader:
    """The header at the start of ``data``, with its count checked against the size of the file.

    Args:
        path: Named in errors.
        data: Bytes that begin with the header.
        versions: Versions that this container may have.
        stored_bytes: Size of the file.

    Raises:
        FormatError: The header is incomplete, or a field is out of range.
    """
    if len(data) < HEADER.size:
        raise FormatError(path, "truncated: the SPZ header is incomplete")
    magic, version, count, degree, fractional_bits, flags, _ = HEADER.unpack_from(data)
    if magic != MAGIC:
        raise FormatError(path, "is not an SPZ file: no NGSP header")
    if version not in versions:
        raise FormatError(path, f"is SPZ version {version}, expected {versions[0]} to {versions[-1]} in this container")
    if degree > SH_DEGREE_MAX:
        raise FormatError(path, f"has SH degree {degree}, at most {SH_DEGREE_MAX} is supported")
    if version > 1 and not 1 <= fractional_bits <= FRACTIONAL_BITS_MAX:
        raise FormatError(path, f"has {fractional_bits} fractional bits, expected 1 to {FRACTIONAL_BITS_MAX}")
    header = SpzHeader(version, count, degree, fractional_bits, flags)
    check_gaussian_count(path, count, header.sh_coefficients, stored_bytes)
    return header
