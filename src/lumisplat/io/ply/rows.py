"""Rows of a PLY element whose properties are plain numbers, as NumPy structured arrays."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import parsing
from lumisplat.io.ply.header import PlyElement, PlyHeader, refuse_truncated

BLOCK_BYTES = 2**20
"""Rows are read in blocks of this size, which stay in the cache while their columns are separated."""

PlyRows = npt.NDArray[np.void]
"""Rows with a field for each property."""


def read_ply_rows(header: PlyHeader, element: PlyElement, block_rows: int | None = None) -> Iterator[PlyRows]:
    """Reads the rows of an element in blocks.

    Args:
        header: Header of the file.
        element: One of its elements; neither it nor an element before it may have list properties.
        block_rows: Rows of a block of a binary file; None: as many as fit into the cache.

    Yields:
        Structured arrays with ``element.count`` rows in total.

    Raises:
        FormatError: The header promises more rows than the file holds (found before anything is allocated), or the
            rows do not parse.
        OSError: The file cannot be read.
    """
    dtype = header.dtype(element)
    start, rows_before = header.start(element)
    if header.encoding == "ascii":
        yield from _ascii_rows(header, element, dtype, rows_before)
        return
    _check_size(header, element, start + element.count * dtype.itemsize)
    with Path(header.path).open("rb") as file:
        file.seek(start)
        step = block_rows or max(1, BLOCK_BYTES // max(1, dtype.itemsize))
        for first in range(0, element.count, step):
            rows = np.fromfile(file, dtype, min(step, element.count - first))
            if len(rows) < min(step, element.count - first):
                raise FormatError(header.path, "the file became shorter while it was read")
            yield rows


def _ascii_rows(
    header: PlyHeader, element: PlyElement, dtype: np.dtype[np.void], rows_before: int
) -> Iterator[PlyRows]:
    # Each number takes at least two bytes, a digit and a separator, which only the last number may lack.
    _check_size(header, element, header.data_offset + 2 * element.count * len(element.properties) - 1)
    if element.count == 0:
        return
    with parsing(header.path, "an ASCII PLY file"), Path(header.path).open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # missing rows are reported below
        file.seek(header.data_offset)
        rows = np.loadtxt(
            file, dtype, comments=None, skiprows=rows_before, max_rows=element.count, ndmin=1, encoding="ascii"
        )
    if len(rows) < element.count:
        refuse_truncated(header, element, f"{len(rows):,}")
    yield rows


def read_ply_element(header: PlyHeader, element: PlyElement) -> PlyRows:
    """All rows of an element as one structured array; see `read_ply_rows`."""
    blocks = list(read_ply_rows(header, element))
    return np.concatenate(blocks) if blocks else np.empty(0, dtype=header.dtype(element))


def _check_size(header: PlyHeader, element: PlyElement, needed: int) -> None:
    if needed > header.file_size:
        refuse_truncated(header, element, f"{header.file_size:,} bytes where at least {needed:,} are needed")
