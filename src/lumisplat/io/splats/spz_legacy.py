"""SPZ versions 1 to 3: a gzip stream of a 16-byte header and six packed sections, then extension records."""

from __future__ import annotations

import itertools
import zlib

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike
from lumisplat.io.splats.columns import SplatColumns
from lumisplat.io.splats.spz_header import HEADER, SpzHeader, parse_spz_header
from lumisplat.io.splats.spz_sections import decode_sections

EXTENSION_BYTES_MAX = 2**16
GZIP_WINDOW = 16 + zlib.MAX_WBITS


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
    return header, decode_sections(header, sections), content[ends[-1] :]


def _inflate(path: PathLike, data: bytes, size: int) -> bytes:
    """The first ``size`` bytes of a gzip stream, or all of them if it is shorter."""
    try:
        return zlib.decompressobj(GZIP_WINDOW).decompress(data, size)
    except zlib.error as error:
        raise FormatError(path, f"damaged: {error}") from None
