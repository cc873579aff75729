"""The PLY container (Turk 1994): a header, then elements of scalar and list properties, ASCII or binary."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

Columns = dict[str, npt.NDArray]
"""A scalar property is one array, (count,). A list property ``name`` is two: ``name``, all items of all rows in a row,
and ``name#``, the number of items of each row."""

Layout = list[tuple[str, str, int]]
"""Name, type and number of values of each field of a row."""


@dataclass(slots=True)
class _Property:
    name: str
    type: str
    count_type: str | None = None


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


class _Cursor:
    """A place in the data, which hands out rows from there."""

    def __init__(self, values: npt.NDArray, order: str) -> None:
        self.values = values
        """Bytes of a binary file, or numbers of an ASCII one."""
        self.order = order
        self.position = 0

    def rows(self, layout: Layout, count: int) -> Columns:
        """The next ``count`` rows, (count, n) each; does not move where there are not enough.

        Raises:
            EOFError: The file ends before.
        """
        widths = [n for _, _, n in layout]
        row_size = sum(n * np.dtype(type_).itemsize for _, type_, n in layout) if self.order else sum(widths)
        size = count * row_size
        if self.position + size > len(self.values):
            raise EOFError
        block = self.values[self.position : self.position + size]
        self.position += size
        if self.order:
            fields = [(str(k), self.order + type_, (n,)) for k, (_, type_, n) in enumerate(layout)]
            table = block.view(fields)
            return {name: table[str(k)] for k, (name, _, _) in enumerate(layout)}
        columns = np.split(block.reshape(count, -1), np.cumsum(widths)[:-1], axis=1)
        return {name: column.astype(type_) for (name, type_, _), column in zip(layout, columns, strict=True)}

    def value(self, type_: str) -> int:
        """The next value, which counts the items of a list.

        Raises:
            EOFError: The file ends here, or the count is negative.
        """
        count = int(self.rows([("", type_, 1)], 1)[""][0, 0])
        if count < 0:
            raise EOFError
        return count


def read_ply_tables(path: Path, data: bytes) -> tuple[dict[str, Columns], str | None]:
    """All elements by name, and the name of the texture file, if the header has one.

    Raises:
        FormatError: The header is malformed, or the data end early.
    """
    order, elements, texture, size = _read_header(path, data)
    body = np.frombuffer(data, np.uint8, offset=size) if order else np.array(data[size:].split(), dtype=np.float64)
    cursor = _Cursor(body, order)
    tables = {}
    for element in elements:
        try:
            tables[element.name] = _read_element(cursor, element)
        except EOFError:
            problem = f"ends within its {element.count:,} {element.name} elements: truncated, or a wrong count"
            raise FormatError(path, problem) from None
    return tables, texture


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], str | None, int]:
    """Byte order (empty: ASCII), elements, texture file and length in bytes."""
    end = data.find(b"end_header")
    size = data.find(b"\n", end) + 1
    if not data.startswith(b"ply") or end < 0 or size == 0:
        raise FormatError(path, "not a PLY file: expected 'ply' ... 'end_header'")
    order, texture = None, None
    elements: list[_Element] = []
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in _BYTE_ORDERS:
                order = _BYTE_ORDERS[name]
            case ["element", name, count] if count.isdigit():
                elements.append(_Element(name, int(count)))
            case ["property", "list", count_type, type_, name] if elements and {count_type, type_} <= _TYPES.keys():
                elements[-1].properties.append(_Property(name, _TYPES[type_], _TYPES[count_type]))
            case ["property", type_, name] if elements and type_ in _TYPES:
                elements[-1].properties.append(_Property(name, _TYPES[type_]))
            case ["comment", "TextureFile", *_]:
                texture = line.split("TextureFile", 1)[1].strip()
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise FormatError(path, f"PLY header line not understood: {line[:60]!r}")
    if order is None:
        raise FormatError(path, "PLY header has no format line")
    return order, elements, texture, size


def _read_element(cursor: _Cursor, element: _Element) -> Columns:
    """At once where all rows have the list lengths of the first; row by row otherwise."""
    if not element.count or not element.properties:
        return {name: np.empty(0) for p in element.properties for name in (p.name, p.name + "#")}
    start = cursor.position
    first = _read_row(cursor, element)
    cursor.position = start
    layout = []
    for p in element.properties:
        layout += [(p.name + "#", p.count_type, 1)] if p.count_type else []
        layout.append((p.name, p.type, first[p.name].shape[1]))
    lists = [p.name + "#" for p in element.properties if p.count_type]
    try:
        table = cursor.rows(layout, element.count)
    except EOFError:
        if not lists:
            raise
        table = None
    if table is None or any((table[name] != first[name]).any() for name in lists):
        cursor.position = start
        rows = [_read_row(cursor, element) for _ in range(element.count)]
        return {name: np.concatenate([row[name][0] for row in rows]) for name in first}
    return {name: column.reshape(-1) for name, column in table.items()}


def _read_row(cursor: _Cursor, element: _Element) -> Columns:
    row: Columns = {}
    for p in element.properties:
        length = 1
        if p.count_type:
            length = cursor.value(p.count_type)
            row[p.name + "#"] = np.array([[length]])
        row |= cursor.rows([(p.name, p.type, length)], 1)
    return row
