"""PLY elements with list properties, whose rows differ in length, such as the polygons of a mesh."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.files.source import read_bytes
from lumisplat.io.ply.header import ENCODINGS, PlyElement, PlyHeader, PlyProperty, refuse_truncated

_ZEROS = re.compile(rb"\0+")


class PlyList(NamedTuple):
    """The lists of one property, of all rows."""

    counts: npt.NDArray[Any]
    """Number of items of each row, shape (rows,)."""
    items: npt.NDArray[Any]
    """The items of all rows, one row after the other."""


class _Span(NamedTuple):
    """The place of one list in the data."""

    start: int
    """Byte of the first item."""
    length: int
    """Number of items."""


def read_ply_lists(header: PlyHeader, element: PlyElement, scalars: Collection[str] = ()) -> dict[str, PlyList]:
    """Reads the list properties of an element.

    Args:
        header: Header of the file.
        element: One of its elements; no element before it may have list properties.
        scalars: Plain numbers of each row that are read, too, as lists of one item.

    Returns:
        The lists by name. Other properties are skipped.

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
        stored = _with_types(element, ENCODINGS[header.encoding])
        data = data[start:]
    lists = _equal_rows(stored, data, _walk(header, stored, data, min(1, element.count), scalars))
    if lists is None:
        spans = _walk(header, stored, data, element.count, scalars)
        lists = {p.name: _gather(p, data, spans[p.name]) for p in stored.properties if p.name in spans}
    codes = {p.name: p.code for p in element.properties}
    return {name: PlyList(counts, items.astype(codes[name])) for name, (counts, items) in lists.items()}


def _with_types(element: PlyElement, order: str, code: str | None = None) -> PlyElement:
    """The element with a byte order before its type codes, or before ``code`` instead of them."""
    properties = (
        PlyProperty(p.name, order + (code or p.code), p.count_code and order + (code or p.count_code))
        for p in element.properties
    )
    return replace(element, properties=tuple(properties))


def _ascii_as_doubles(header: PlyHeader, element: PlyElement, data: bytes, rows_before: int) -> bytes:
    """The rows of a text file as binary data in which every number, also each count, is a double."""
    lines = [line for line in data[header.data_offset :].splitlines() if line.strip()]
    rows = lines[rows_before : rows_before + element.count]
    if len(rows) < element.count:
        refuse_truncated(header, element, f"{len(rows):,}")
    return np.array(b" ".join(rows).split(), dtype="<f8").tobytes()


def _walk(
    header: PlyHeader, element: PlyElement, data: bytes, count: int, scalars: Collection[str]
) -> dict[str, list[_Span]]:
    """Finds the lists and the scalars of the first ``count`` rows, all of which must be complete."""
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
                    refuse_truncated(header, element, f"{row:,}")
                length = int(counter.unpack_from(data, position)[0])
                if length < 0:
                    raise FormatError(header.path, f"row {row:,} of {element.name} has {length} {name}")
                position += counter.size
            if name in spans:
                spans[name].append(_Span(position, length))
            position += length * size
        if position > len(data):
            refuse_truncated(header, element, f"{row:,}")
        row += 1
    return spans


def _equal_rows(element: PlyElement, data: bytes, first: dict[str, list[_Span]]) -> dict[str, PlyList] | None:
    """The lists if all rows have lists of the lengths in the first row, as in a mesh of triangles; None otherwise."""
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
    """The lists at the given places."""
    size = np.dtype(prop.code).itemsize
    items = b"".join([data[start : start + length * size] for start, length in spans])
    return PlyList(np.array([span.length for span in spans]), np.frombuffer(items, prop.code))
