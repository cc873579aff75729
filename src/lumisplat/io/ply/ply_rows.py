"""PLY: the header, and the rows of an element as NumPy structured arrays. `ply_lists` reads rows that differ in length.

Format: Greg Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import itertools
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, parsing

HEADER_BYTES_MAX = 2**20
"""A header is sought within this many bytes of the start."""

BLOCK_BYTES = 2**20
"""Rows are read in blocks of this size: they stay in the cache while their columns are taken apart."""

ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

SCALAR_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """One number of each row, or a list of them."""

    name: str
    code: str
    """NumPy type code, of the items where it is a list."""
    count_code: str = ""
    """NumPy type code of the number of items; empty: not a list."""


@dataclass(frozen=True, slots=True)
class PlyElement:
    """One element of a header."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Property names in file order."""
        return tuple(prop.name for prop in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A parsed header, and where the data begin."""

    path: str
    encoding: str
    """A key of `ENCODINGS`."""
    comments: tuple[str, ...]
    elements: tuple[PlyElement, ...]
    data_offset: int
    """Bytes before the first row."""
    file_size: int
    """Bytes."""

    def element(self, name: str) -> PlyElement | None:
        """The element of that name, if there is one."""
        return next((element for element in self.elements if element.name == name), None)

    def required(self, name: str) -> PlyElement:
        """The element of that name.

        Raises:
            FormatError: There is none.
        """
        element = self.element(name)
        if element is None:
            raise FormatError(self.path, f"the PLY file has no element {name}")
        return element

    def dtype(self, element: PlyElement) -> np.dtype:
        """Structured type of one row, packed, in the byte order of the file.

        Raises:
            FormatError: Rows have lists, and no fixed length.
        """
        if any(prop.count_code for prop in element.properties):
            raise FormatError(self.path, f"PLY element {element.name} has list properties, expected plain numbers")
        return np.dtype([(prop.name, ENCODINGS[self.encoding] + prop.code) for prop in element.properties])

    def start(self, element: PlyElement) -> tuple[int, int]:
        """Where the rows of an element begin: the byte in a binary file, and the number of rows before.

        Raises:
            FormatError: An element before it has list properties.
        """
        before = list(itertools.takewhile(lambda other: other is not element, self.elements))
        size = sum(other.count * self.dtype(other).itemsize for other in before)
        return self.data_offset + size, sum(other.count for other in before)


def read_ply_header(path: PathLike) -> PlyHeader:
    """Parses the header of a PLY file; no row is read.

    Raises:
        FormatError: The file is no PLY file, or its header is damaged.
        OSError: The file cannot be read.
    """
    with Path(path).open("rb") as file:
        head = file.read(HEADER_BYTES_MAX)
        size = os.fstat(file.fileno()).st_size
    if not re.match(rb"ply\s", head):
        raise FormatError(path, "is not a PLY file: it does not begin with 'ply'")
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if end is None:
        raise FormatError(path, "the PLY header has no end: the file is truncated or damaged")
    lines = [line.strip() for line in head[: end.start()].decode("utf-8", "replace").splitlines()[1:]]
    with parsing(path, "a PLY file"):
        encoding, comments, elements = _parse_lines(path, [line for line in lines if line])
    return PlyHeader(os.fspath(path), encoding, comments, elements, end.end(), size)


def _parse_lines(path: PathLike, lines: list[str]) -> tuple[str, tuple[str, ...], tuple[PlyElement, ...]]:
    encoding = ""
    comments: list[str] = []
    elements: list[tuple[str, int, list[PlyProperty]]] = []
    for line in lines:
        match line.split():
            case ["comment" | "obj_info" as keyword, *_]:
                comments.append(line[len(keyword) :].strip())
            case ["format", name, *_] if name in ENCODINGS:
                encoding = name
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", kind, name] if elements and kind in SCALAR_TYPES:
                elements[-1][2].append(PlyProperty(name, SCALAR_TYPES[kind]))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= SCALAR_TYPES.keys():
                elements[-1][2].append(PlyProperty(name, SCALAR_TYPES[kind], SCALAR_TYPES[count]))
            case _:
                raise FormatError(path, f"unexpected PLY header line {line[:80]!r}")
    if not encoding:
        raise FormatError(path, "the PLY header has no 'format' line")
    for name, _, properties in elements:
        if len({prop.name for prop in properties}) < len(properties):
            raise FormatError(path, f"the PLY header lists a property of {name} twice")
    return encoding, tuple(comments), tuple(PlyElement(name, n, tuple(props)) for name, n, props in elements)


def read_ply_rows(header: PlyHeader, element: PlyElement) -> Iterator[np.ndarray]:
    """Reads the rows of an element in blocks that fit the cache.

    Args:
        header: Of the file.
        element: One of its elements; neither it nor any before it may have list properties.

    Yields:
        Structured arrays, together ``element.count`` rows.

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
        step = max(1, BLOCK_BYTES // max(1, dtype.itemsize))
        for first in range(0, element.count, step):
            rows = np.fromfile(file, dtype, min(step, element.count - first))
            if len(rows) < min(step, element.count - first):
                raise FormatError(header.path, "the file became shorter while it was read")
            yield rows


def _ascii_rows(header: PlyHeader, element: PlyElement, dtype: np.dtype, rows_before: int) -> Iterator[np.ndarray]:
    # A number takes at least two bytes, itself and what separates it; only the last may lack the second.
    _check_size(header, element, header.data_offset + 2 * element.count * len(element.properties) - 1)
    if element.count == 0:
        return
    with parsing(header.path, "an ASCII PLY file"), Path(header.path).open("rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no rows: reported below
        file.seek(header.data_offset)
        rows = np.loadtxt(
            file, dtype, comments=None, skiprows=rows_before, max_rows=element.count, ndmin=1, encoding="ascii"
        )
    if len(rows) < element.count:
        refuse_truncated(header, element, f"{len(rows):,}")
    yield rows


def read_ply_element(header: PlyHeader, element: PlyElement) -> np.ndarray:
    """All rows of an element as one structured array; see `read_ply_rows`."""
    blocks = list(read_ply_rows(header, element))
    return np.concatenate(blocks) if blocks else np.empty(0, dtype=header.dtype(element))


def _check_size(header: PlyHeader, element: PlyElement, needed: int) -> None:
    if needed > header.file_size:
        refuse_truncated(header, element, f"{header.file_size:,} bytes where at least {needed:,} are needed")


def refuse_truncated(header: PlyHeader, element: PlyElement, found: str) -> NoReturn:
    """Raises the FormatError of a file that holds only ``found`` of an element."""
    raise FormatError(
        header.path, f"truncated: the header promises {element.count:,} rows of {element.name}, the file holds {found}"
    )


def ply_header_bytes(comments: tuple[str, ...], elements: list[tuple[str, int, str, list[str]]]) -> bytes:
    """A little-endian header.

    Args:
        comments: One line each; line breaks inside become spaces.
        elements: (name, count, PLY type of all its properties, property names).
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(comment.split())}".rstrip() for comment in comments]
    for name, count, kind, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {prop}" for prop in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()
