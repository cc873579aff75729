"""SPZ versions 1 to 3: a gzip stream of a 16-byte header and six packed sections, then extension records."""

from __future__ import annotations

import itertools
import zlib

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import Floats, SplatColumns
from lumisplat.io.splats.smallest_three import unpack_smallest_three
from lumisplat.io.splats.spz_header import HEADER, SpzHeader, parse_spz_header

COLOR_SCALE = 0.15
"""A colour byte is 255 (0.5 + 0.15 DC): a range wider than 0..1, so that no coefficient is clipped."""

EXTENSION_BYTES_MAX = 2**16
GZIP_WINDOW = 16 + zlib.MAX_WBITS

Bytes = npt.NDArray[np.uint8]


def read_legacy(path: PathLike, data: bytes) -> tuple[SpzHeader, SplatColumns, bytes]:
    """Decodes a gzip container.

    Args:
        path: Named in errors.
        data: The whole file.

    Returns:
        Header, Gaussians in the axes of the file, and the bytes of extension records.

    Raises:
        FormatError: The file is damaged or truncated.
    """
    header = parse_spz_header(path, _inflate(path, data, HEADER.size), range(1, 4), len(data))
    size = sum(header.section_sizes)
    # Inflates at most what the header announces, however long the stream is.
    content = _inflate(path, data, HEADER.size + size + EXTENSION_BYTES_MAX)
    if len(content) < HEADER.size + size:
        raise FormatError(
            path, f"truncated: {header.count:,} Gaussians take {size:,} bytes, {len(content) - HEADER.size:,} are there"
        )
    ends = np.cumsum((HEADER.size, *header.section_sizes))
    sections = [np.frombuffer(content, np.uint8)[a:b] for a, b in itertools.pairwise(ends)]
    return header, _decode(header, sections), content[ends[-1] :]


def _inflate(path: PathLike, data: bytes, size: int) -> bytes:
    """The first ``size`` bytes of a gzip stream, or all of them if it is shorter."""
    try:
        return zlib.decompressobj(GZIP_WINDOW).decompress(data, size)
    except zlib.error as error:
        raise FormatError(path, f"damaged: {error}") from None


def _decode(header: SpzHeader, sections: list[Bytes]) -> SplatColumns:
    positions, alphas, colors, scales, rotations, sh = sections
    n = header.count
    coefficients = np.empty((n, header.sh_coefficients, 3), dtype=np.float32)
    coefficients[:, 0] = (colors.reshape(n, 3) / np.float32(255.0) - np.float32(0.5)) / np.float32(COLOR_SCALE)
    coefficients[:, 1:] = (sh.reshape(n, -1, 3) - np.float32(128.0)) / np.float32(128.0)
    half = header.version == 1
    return SplatColumns(
        means=_half_positions(positions) if half else _fixed_positions(positions, header.fractional_bits),
        rotations_wxyz=_packed_rotations(rotations) if header.version >= 3 else _byte_rotations(rotations),
        log_scales=scales.reshape(n, 3) / np.float32(16.0) - np.float32(10.0),
        opacities=alphas / np.float32(255.0),
        sh=coefficients,
        opacities_are_logits=False,
    )


def _half_positions(section: Bytes) -> Floats:
    return section.view("<f2").astype(np.float32).reshape(-1, 3)


def _fixed_positions(section: Bytes, fractional_bits: int) -> Floats:
    """24-bit two's complement, shape (N, 3)."""
    parts = section.reshape(-1, 3, 3).astype(np.int32)
    # Shifted to the high bytes of an int32 first, so that shifting back down extends the sign.
    fixed = (parts[..., 0] << 8 | parts[..., 1] << 16 | parts[..., 2] << 24) >> 8
    return fixed * np.float32(2.0**-fractional_bits)


def _byte_rotations(section: Bytes) -> Floats:
    """x, y and z as bytes; w is positive and follows from the unit length. Shape (N, 4), wxyz."""
    xyz = section.reshape(-1, 3) / np.float32(127.5) - np.float32(1.0)
    return unpack_smallest_three(np.zeros(len(xyz), dtype=np.int64), xyz)


def _packed_rotations(section: Bytes) -> Floats:
    """Smallest three of xyzw: a 2-bit index, then three times a sign and 9 bits of magnitude. Shape (N, 4), wxyz."""
    packed = section.view("<u4")
    fields = np.stack([packed >> np.uint32(shift) & np.uint32(0x3FF) for shift in (20, 10, 0)], axis=1)
    magnitude = (fields & np.uint32(0x1FF)) * np.float32(np.sqrt(0.5) / 511.0)
    smallest = np.where(fields >> np.uint32(9), -magnitude, magnitude).astype(np.float32)
    return np.roll(unpack_smallest_three(packed >> np.uint32(30), smallest), 1, axis=1)
