"""Headers of PLY files. Format: Greg Turk, "The PLY Polygon File Format" (1994)."""

from __future__ import annotations

import itertools
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import PathLike, parsing

HEADER_BYTES_MAX = 2**20
"""Largest number of bytes that a header may have."""

ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}

SCALAR_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


_PREFIXES = re.compile(r"(?:scalar_|scal_)+")
"""Before the names of scalar fields in files of CloudCompare, once for each time that it wrote them."""

_COLOR_NAMES = (("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
"""Other names of red, green and blue."""


@dataclass(frozen=True, slots=True)
class PlyProperty:
    """A number, or a list of numbers, of each row."""

    name: str
    code: str
    """NumPy type code of the number, or of the items of the list."""
    count_code: str | None = None
    """NumPy type code of the number of items of a list; None: this is not a list."""


@dataclass(frozen=True, slots=True)
class PlyElement:
    """One element of a header: a table of rows."""

    name: str
    count: int
    properties: tuple[PlyProperty, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties, in the file's order."""
        return tuple(prop.name for prop in self.properties)


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """A parsed header."""

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
        """The element of that name, None if there is none."""
        return next((element for element in self.elements if element.name == name), None)

    def required(self, name: str) -> PlyElement:
        """The element of that name.

        Raises:
            FormatError: There is no such element.
        """
        element = self.element(name)
        if element is None:
            raise FormatError(self.path, f"the PLY file has no element {name}")
        return element

    def dtype(self, element: PlyElement) -> np.dtype[np.void]:
        """Structured type of one row, packed, in the byte order of the file.

        Raises:
            FormatError: The element has list properties, so that its rows have no fixed length.
        """
        if any(prop.count_code for prop in element.properties):
            raise FormatError(self.path, f"PLY element {element.name} has list properties, expected plain numbers")
        return np.dtype([(prop.name, ENCODINGS[self.encoding] + prop.code) for prop in element.properties])

    def start(self, element: PlyElement) -> tuple[int, int]:
        """The byte at which the rows of an element begin in a binary file, and the number of rows before them.

        Raises:
            FormatError: An element before it has list properties.
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
        head = file.read(HEADER_BYTES_MAX)
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
        properties[:] = _with_usual_names(properties)
        if encoding == "ascii":  # text has as many digits as were written, whatever type the header says
            wide = {"x", "y", "z"}
            properties[:] = [replace(prop, code="f8") if prop.name in wide else prop for prop in properties]
        if len({prop.name for prop in properties}) < len(properties):
            raise FormatError(path, f"the PLY header lists a property of {name} twice")
    return encoding, tuple(comments), tuple(PlyElement(name, n, tuple(props)) for name, n, props in elements)


def _with_usual_names(properties: list[PlyProperty]) -> list[PlyProperty]:
    """The properties in lower case, without CloudCompare's prefixes, colours as red, green, blue.

    Two never get the same name.
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


def refuse_truncated(header: PlyHeader, element: PlyElement, found: str) -> NoReturn:
    """Raises the `FormatError` of a file that holds only ``found`` of an element."""
    raise FormatError(
        header.path, f"truncated: the header promises {element.count:,} rows of {element.name}, the file holds {found}"
    )


def ply_header_bytes(comments: tuple[str, ...], elements: list[tuple[str, int, str, list[str]]]) -> bytes:
    """The header of a little-endian file.

    Args:
        comments: One line each; line breaks inside become spaces.
        elements: Name, count, PLY type of all properties, and property names of each element.
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += [f"comment {' '.join(comment.split())}".rstrip() for comment in comments]
    for name, count, kind, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {prop}" for prop in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()
