"""Reads the PLY container: headers, rows of numbers as structured arrays, and rows with lists.

An element is a table of rows. Rows with list properties, such as the polygons of a mesh, differ in length. Format: Greg
Turk, "The PLY Polygon File Format" (1994).
"""

from __future__ import annotations

import itertools
import os
import re
import struct
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, parsing, read_bytes

_HEADER_BYTES_MAX = 2**20
"""Largest size of a header in bytes."""

_ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

_SCALAR_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


_PREFIXES = re.compile(r"(?:scalar_|scal_)+")
"""Matches ``scalar_`` and ``scal_``, once or repeated, which CloudCompare puts before property names at each save."""

_COLOR_NAMES = (("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Triples of property names that some writers use in place of red, green and blue."""

_BLOCK_BYTES = 2**20
"""Bytes of rows that `read_ply_rows` reads at once: few enough to stay in the CPU cache while columns are copied."""

PlyRows = npt.NDArray[np.void]
"""Rows of an element as a structured array, with a field for each property."""

_ZEROS = re.compile(rb"\0+")


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """A property of an element: in each row a number, or a list of numbers."""

    name: str
    code: str
    """NumPy type code of the number, or of the list's items."""
    count_code: str | None = None
    """NumPy type code of the length of a list; None if the property is a number."""


@dataclass(frozen=True, slots=True)
class PlyElement:
    """An element of a file: a table of rows, as the header declares it."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties, in file order."""
        return tuple(prop.name for prop in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A parsed header of a PLY file."""

    path: str
    encoding: str
    """Encoding of the rows: ``ascii``, ``binary_little_endian`` or ``binary_big_endian``."""
    comments: tuple[str, ...]
    elements: tuple[PlyElement, ...]
    data_offset: int
    """Length of the header in bytes; the first row follows it."""
    file_size: int
    """Size of the file in bytes."""

    def element(self, name: str) -> PlyElement | None:
        """Returns the element with the given name; None if the file has no such element."""
        return next((element for element in self.elements if element.name == name), None)

    def required(self, name: str) -> PlyElement:
        """Returns the element with the given name.

        Raises:
            FormatError: There is no such element.
        """
        element = self.element(name)
        if element is None:
            raise FormatError(self.path, f"the PLY file has no element {name}")
        return element

    def dtype(self, element: PlyElement) -> np.dtype[np.void]:
        """Returns the structured NumPy type of an element's rows, without padding, in the byte order of the file.

        Raises:
            FormatError: The element has list properties, so its rows have no fixed length.
        """
        if any(prop.count_code for prop in element.properties):
            raise FormatError(self.path, f"PLY element {element.name} has list properties, expected only numbers")
        return np.dtype([(prop.name, _ENCODINGS[self.encoding] + prop.code) for prop in element.properties])

    def start(self, element: PlyElement) -> tuple[int, int]:
        """Returns where the rows of an element begin: byte offset in a binary file, and number of rows before them.

        Raises:
            FormatError: An earlier element has list properties, so that its size is unknown.
        """
        before = list(itertools.takewhile(lambda other: other is not element, self.elements))
        size = sum(other.count * self.dtype(other).itemsize for other in before)
        return self.data_offset + size, sum(other.count for other in before)


def read_ply_header(path: PathLike) -> PlyHeader:
    """Parses the header of a PLY file, without its rows.

    Raises:
        FormatError: The file is not a PLY file, or its header is damaged.
        OSError: The file cannot be read.
    """
    with Path(path).open("rb") as file:
        head = file.read(_HEADER_BYTES_MAX)
        size = os.fstat(file.fileno()).st_size
    if not re.match(rb"(\xef\xbb\xbf)?ply\s", head):
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
            case ["format", name, *_] if name in _ENCODINGS:
                encoding = name
            case ["element", name, count] if count.isdecimal():
                elements.append((name, int(count), []))
            case ["property", kind, name] if elements and kind in _SCALAR_TYPES:
                elements[-1][2].append(PlyProperty(name, _SCALAR_TYPES[kind]))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= _SCALAR_TYPES.keys():
                elements[-1][2].append(PlyProperty(name, _SCALAR_TYPES[kind], _SCALAR_TYPES[count]))
            case _:
                raise FormatError(path, f"unexpected PLY header line {line[:80]!r}")
    if not encoding:
        raise FormatError(path, "the PLY header has no 'format' line")
    for name, _, properties in elements:
        properties[:] = _with_usual_names(properties)
        if encoding == "ascii":  # ASCII may have more digits than the type in the header
            wide = {"x", "y", "z"}
            properties[:] = [replace(prop, code="f8") if prop.name in wide else prop for prop in properties]
        if len({prop.name for prop in properties}) < len(properties):
            raise FormatError(path, f"the PLY header lists a property of {name} twice")
    return encoding, tuple(comments), tuple(PlyElement(name, n, tuple(props)) for name, n, props in elements)


def _with_usual_names(properties: list[PlyProperty]) -> list[PlyProperty]:
    """Normalises property names: lower case, no CloudCompare prefix (``scalar_``), colours named red, green and blue.

    A property keeps its name if another property already has the new name or would get it, too.
    """
    names = [prop.name for prop in properties]
    plain = [(_PREFIXES.sub("", name, count=1) if _PREFIXES.match(name) else name).lower() for name in names]
    for others in _COLOR_NAMES:
        if set(others) <= set(plain):
            usual = dict(zip(others, ("red", "green", "blue"), strict=True))
            plain = [usual.get(name, name) for name in plain]
    return [
        replace(prop, name=name) if name and name not in names and plain.count(name) == 1 else prop
        for prop, name in zip(properties, plain, strict=True)
    ]


def _refuse_truncated(header: PlyHeader, element: PlyElement, found: str) -> NoReturn:
    """Raises a `FormatError`: the header promises more rows of ``element`` than ``found``, the count in the file."""
    raise FormatError(
        header.path, f"truncated: the header promises {element.count:,} rows of {element.name}, the file holds {found}"
    )


def ply_header_bytes(comments: tuple[str, ...], elements: list[tuple[str, int, str, list[str]]]) -> bytes:
    """Returns the header of a binary little-endian PLY file.

    Args:
        comments: One comment line each; line breaks inside a comment become spaces.
        elements: For each element its name, its row count, the PLY type of all its properties, and their names.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(comment.split())}".rstrip() for comment in comments]
    for name, count, kind, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {prop}" for prop in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def read_ply_rows(header: PlyHeader, element: PlyElement, block_rows: int | None = None) -> Iterator[PlyRows]:
    """Reads the rows of an element in blocks.

    Args:
        header: Header of the file.
        element: An element without list properties; earlier elements have none either.
        block_rows: Rows per block of a binary file; None uses as many as fit into the CPU cache.

    Yields:
        Structured arrays with ``element.count`` rows in total.

    Raises:
        FormatError: The header promises more rows than the file holds (found before anything is allocated), or the rows
            do not parse.
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
        step = block_rows or max(1, _BLOCK_BYTES // max(1, dtype.itemsize))
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
        _refuse_truncated(header, element, f"{len(rows):,}")
    yield rows


def read_ply_element(header: PlyHeader, element: PlyElement) -> PlyRows:
    """Reads all rows of an element as one structured array; see `read_ply_rows`."""
    blocks = list(read_ply_rows(header, element))
    return np.concatenate(blocks) if blocks else np.empty(0, dtype=header.dtype(element))


def _check_size(header: PlyHeader, element: PlyElement, needed: int) -> None:
    if needed > header.file_size:
        _refuse_truncated(header, element, f"{header.file_size:,} bytes where at least {needed:,} are needed")


class PlyList(NamedTuple):
    """A list property: its lists in all rows of an element."""

    counts: npt.NDArray[Any]
    """Number of items of the list in each row, shape (rows,)."""
    items: npt.NDArray[Any]
    """Items of the lists of all rows, concatenated."""


class _Span(NamedTuple):
    """Position and length of one list of one row, within the binary data of an element's rows."""

    start: int
    """Byte offset of the list's first item from the beginning of the element's rows."""
    length: int
    """Number of items in the list."""


def read_ply_lists(header: PlyHeader, element: PlyElement, scalars: Collection[str] = ()) -> dict[str, PlyList]:
    """Reads the list properties of an element.

    Args:
        header: Header of the file.
        element: An element of the file; earlier elements have no list properties.
        scalars: Names of number properties to read as lists of one item.

    Returns:
        The lists by property name. Other properties are skipped.

    Raises:
        FormatError: The file ends before its last row, or the rows do not parse.
        OSError: The file cannot be read.
    """
    start, rows_before = header.start(element)
    data = read_bytes(header.path)
    if header.encoding == "ascii":
        stored = _with_types(element, "<", "f8")
        data = _ascii_as_doubles(header, element, data, rows_before)
    else:
        stored = _with_types(element, _ENCODINGS[header.encoding])
        data = data[start:]
    lists = _equal_rows(stored, data, _walk(header, stored, data, min(1, element.count), scalars))
    if lists is None:
        spans = _walk(header, stored, data, element.count, scalars)
        lists = {p.name: _gather(p, data, spans[p.name]) for p in stored.properties if p.name in spans}
    codes = {p.name: p.code for p in element.properties}
    return {name: PlyList(counts, items.astype(codes[name])) for name, (counts, items) in lists.items()}


def _with_types(element: PlyElement, order: str, code: str | None = None) -> PlyElement:
    """Returns the element with the byte order ``order`` (``<`` or ``>``) put before each NumPy type code.

    If ``code`` is given, it replaces the types of all numbers, list items and list lengths.
    """
    properties = (
        PlyProperty(p.name, order + (code or p.code), p.count_code and order + (code or p.count_code))
        for p in element.properties
    )
    return replace(element, properties=tuple(properties))


def _ascii_as_doubles(header: PlyHeader, element: PlyElement, data: bytes, rows_before: int) -> bytes:
    """Converts an element's rows in a text file to binary data in which every number, also a list length, is a double.

    Args:
        header: Header of the file.
        element: The element.
        data: Contents of the file.
        rows_before: Number of rows of earlier elements.
    """
    lines = [line for line in data[header.data_offset :].splitlines() if line.strip()]
    rows = lines[rows_before : rows_before + element.count]
    if len(rows) < element.count:
        _refuse_truncated(header, element, f"{len(rows):,}")
    return np.array(b" ".join(rows).split(), dtype="<f8").tobytes()


def _walk(
    header: PlyHeader, element: PlyElement, data: bytes, count: int, scalars: Collection[str]
) -> dict[str, list[_Span]]:
    """Locates every list in the first ``count`` rows of an element, and returns the locations by property name.

    Properties in ``scalars`` are numbers, located as lists of one item. All other numbers are skipped.

    Args:
        header: Header of the file, for messages.
        element: The element.
        data: Binary data of the element's rows.
        count: Number of rows to read.
        scalars: Names of number properties to locate.

    Raises:
        FormatError: The data has fewer than ``count`` rows, or a list has a negative length.
    """
    counters = [
        struct.Struct(p.count_code[0] + np.dtype(p.count_code).char) if p.count_code else None
        for p in element.properties
    ]
    sizes = [np.dtype(p.code).itemsize for p in element.properties]
    fields = list(zip(element.names, counters, sizes, strict=True))
    spans: dict[str, list[_Span]] = {name: [] for name, counter, _ in fields if counter or name in scalars}
    position, row = 0, 0
    empty_row = b"\0" * sum(counter.size for _, counter, _ in fields if counter)
    has_lists_only = bool(fields) and all(counter for _, counter, _ in fields)
    while row < count:
        if has_lists_only and data.startswith(empty_row, position):
            zeros = _ZEROS.match(data, position)
            assert zeros is not None
            empty = min(count - row, len(zeros[0]) // len(empty_row))
            for name in spans:
                spans[name] += [_Span(position, 0)] * empty
            position, row = position + empty * len(empty_row), row + empty
            continue
        for name, counter, size in fields:
            length = 1
            if counter:
                if position + counter.size > len(data):
                    _refuse_truncated(header, element, f"{row:,}")
                length = int(counter.unpack_from(data, position)[0])
                if length < 0:
                    raise FormatError(
                        header.path, f"row {row:,} of {element.name} has a list {name} of length {length}"
                    )
                position += counter.size
            if name in spans:
                spans[name].append(_Span(position, length))
            position += length * size
        if position > len(data):
            _refuse_truncated(header, element, f"{row:,}")
        row += 1
    return spans


def _equal_rows(element: PlyElement, data: bytes, first: dict[str, list[_Span]]) -> dict[str, PlyList] | None:
    """Returns the lists of all rows at once if all rows have lists of equal lengths, as in a triangle mesh.

    Returns None if any list differs in length from the first row's list of the same property.

    Args:
        element: The element.
        data: Binary data of the element's rows.
        first: Positions of the lists in the first row.
    """
    fields: list[tuple[Any, ...]] = []
    for p in element.properties:
        if p.count_code:
            fields.append((f"{p.name} count", p.count_code))
        fields.append((p.name, p.code, tuple(span.length for span in first.get(p.name, ()))))
    dtype = np.dtype(fields)
    if element.count * dtype.itemsize > len(data):
        return None
    rows = np.frombuffer(data, dtype, element.count)
    counts = {p.name: rows[f"{p.name} count"] if p.count_code else np.ones(len(rows)) for p in element.properties}
    lists = {name: PlyList(counts[name], rows[name].reshape(-1)) for name in first}
    equal = all((lists[name].counts == span.length).all() for name, spans in first.items() for span in spans)
    return lists if equal else None


def _gather(prop: PlyProperty, data: bytes, spans: list[_Span]) -> PlyList:
    """Copies the lists of the property ``prop`` from the positions ``spans`` in the binary data to one array."""
    size = np.dtype(prop.code).itemsize
    items = b"".join([data[start : start + length * size] for start, length in spans])
    return PlyList(np.array([span.length for span in spans]), np.frombuffer(items, prop.code))
