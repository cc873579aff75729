"""Reads TOML tables with type checks, and writes tables as TOML that ``tomllib`` reads back to equal values.

Error messages name the line and the key, and suggest the closest allowed key. ``tomllib`` gives no line numbers, so
this module finds them.

The keys of a table for a scene dataclass are the names of the dataclass's fields; angles are in degrees.
"""

from __future__ import annotations

import math
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple, TypeGuard, cast

import numpy as np

from lumisplat.config.checks import is_number, is_whole, suggestion
from lumisplat.config.setting import Setting, settings_of
from lumisplat.errors import FormatError, LumisplatError
from lumisplat.io.files.source import PathLike, TextureBytes, is_list, is_object, named_path, read_text

TOML_KEY_PARTS_MAX = 32
"""Largest number of parts of a dotted key; scene files use up to three. The time that ``tomllib`` takes is quadratic
in the number of parts."""

KeyPath = tuple[str | int, ...]
"""Keys and array indices that lead from the top of the document to a value, such as ``("splats", 1, "position")``."""

_TOKEN = re.compile(
    r"""(?P<blank>[ \t\r]+|\#[^\n]*)
      | (?P<newline>\n)
      | (?P<string>\"{3}(?s:(?:\\.|[^\\])*?)\"{3,5} | '{3}(?s:.*?)'{3,5} | "(?:\\.|[^"\\\n])*" | '[^'\n]*')
      | (?P<mark>[\[\]{}=,.])
      | (?P<bare>[^\s\[\]{}=,.\#"']+)""",
    re.VERBOSE,
)

Values = dict[str, Any]
"""Values of a table by key, with checked types."""


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


def line_numbers(text: str) -> dict[KeyPath, int]:
    """Returns the line of every key, table and element of an array of tables, counted from 1.

    Args:
        text: Valid TOML, already parsed by tomllib.
    """
    return _Scanner(text).lines


class _Scanner:
    """Scans the tokens of a TOML document that tomllib has accepted, and records the line of every key in ``lines``."""

    def __init__(self, text: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._tokens: list[_Token] = []
        line = 1
        for match in _TOKEN.finditer(text):
            if match.lastgroup != "blank":
                self._tokens.append(_Token(match.lastgroup or "", match[0], line))
            line += match[0].count("\n")
        self._tokens.append(_Token("newline", "\n", line))
        self._at = 0
        self._array_sizes: dict[KeyPath, int] = {}
        table: KeyPath = ()
        while self._at < len(self._tokens):
            token = self._next()
            if token.text == "[":
                table = self._header()
            elif token.kind != "newline":
                self._at -= 1
                self._pair(table)

    def _next(self) -> _Token:
        self._at += 1
        return self._tokens[self._at - 1]

    @property
    def _upcoming(self) -> _Token:
        return self._tokens[self._at]

    def _header(self) -> KeyPath:
        """Reads the header of a table after its first bracket: ``[a.b]`` or ``[[a.b]]``."""
        in_array = self._upcoming.text == "["
        self._at += in_array
        keys, line = self._keys("]")
        self._at += in_array
        path: KeyPath = ()
        for key in keys[:-1]:
            path = self._latest((*path, key))
        path = (*path, keys[-1])
        if in_array:
            index = self._array_sizes.get(path, 0)
            self._array_sizes[path] = index + 1
            self.lines.setdefault(path, line)
            path = (*path, index)
        else:
            path = self._latest(path)
        self.lines.setdefault(path, line)
        return path

    def _latest(self, path: KeyPath) -> KeyPath:
        """Returns ``path``, or if it leads to an array of tables, the path of the array's last table so far."""
        return (*path, self._array_sizes[path] - 1) if path in self._array_sizes else path

    def _keys(self, end: str) -> tuple[list[str], int]:
        """Reads a dotted key and the token after the key. Returns the key's parts and the line of the first part."""
        keys: list[str] = []
        line = self._upcoming.line
        while (token := self._next()).text != end:
            if token.kind == "bare":
                keys.append(token.text)
            elif token.kind == "string":
                keys.append(tomllib.loads(f"key = {token.text}")["key"])
        return keys, line

    def _pair(self, table: KeyPath) -> None:
        """Reads ``key = value`` and records the key's line; ``table`` is the path of the table with this pair."""
        keys, line = self._keys("=")
        for depth in range(len(keys)):
            self.lines.setdefault((*table, *keys[: depth + 1]), line)
        self._value((*table, *keys))

    def _value(self, path: KeyPath) -> None:
        token = self._next()
        if token.text in ("[", "{"):
            self._members(path, "]" if token.text == "[" else "}")
        elif token.kind != "string":  # a number or a date: bare parts separated by dots
            while self._upcoming.kind == "bare" or self._upcoming.text == ".":
                self._at += 1

    def _members(self, path: KeyPath, end: str) -> None:
        """Reads the rest of an array or inline table at ``path``, up to its closing bracket ``end``."""
        index = 0
        while (token := self._next()).text != end:
            if token.text in ("\n", ","):
                continue
            self._at -= 1
            if end == "}":
                self._pair(path)
            else:
                self.lines[(*path, index)] = token.line
                self._value((*path, index))
                index += 1


class Kind(NamedTuple):
    """Expected type of a TOML value, such as a number or three numbers."""

    expected: str
    """Description of the type for error messages, such as ``three numbers``."""
    accepts: Callable[[object], bool]
    """Function that returns whether a value has this type."""
    help: str = ""
    """Meaning of a key with this type, one line for docs/scene_file.md."""

    def about(self, text: str) -> Kind:
        """Returns this kind with ``text`` as its help text."""
        return self._replace(help=text)


def _is_number_or_flag(value: object) -> bool:
    return isinstance(value, bool) or is_number(value)


def _is_instance(kind: type | UnionType) -> Callable[[object], bool]:
    return lambda value: isinstance(value, kind)


def _is_name_or_number(value: object) -> bool:
    return isinstance(value, str) or is_whole(value)


def _is_vector(count: int) -> Callable[[object], bool]:
    return lambda value: is_list(value) and len(value) == count and all(map(is_number, value))


def _is_numbers(value: object) -> bool:
    return is_list(value) and all(map(is_number, value))


def _is_color(value: object) -> bool:
    return is_number(value) or _is_vector(3)(value)


def _is_array_of_tables(value: object) -> TypeGuard[list[dict[str, object]]]:
    """Returns whether a value is a list that contains only tables; an empty list counts."""
    return is_list(value) and all(map(is_object, value))


TEXT = Kind("a string", _is_instance(str))

FLAG = Kind("true or false", _is_instance(bool))

NUMBER = Kind("a number", is_number)

NUMBER_OR_FLAG = Kind("a number, true or false", _is_number_or_flag)

WHOLE = Kind("a whole number", is_whole)

VECTOR = Kind("three numbers", _is_vector(3))

NUMBERS = Kind("numbers in brackets", _is_numbers)

PAIR = Kind("two numbers", _is_vector(2))

COEFFICIENTS = Kind("six numbers, k1 k2 k3 k4 p1 p2", _is_vector(6))

QUATERNION = Kind("four numbers, w x y z", _is_vector(4))

COLOR = Kind("a number or three", _is_color)

TABLE = Kind("a table", is_object)

TABLES = Kind("tables, written with double brackets", _is_array_of_tables)

NAME_OR_NUMBER = Kind("a name or a whole number", _is_name_or_number)

TEXT_OR_TABLE = Kind("a name or a table", _is_instance(str | dict))


class _Source(NamedTuple):
    """File of a table: its path, its text and the counter of its textures."""

    path: Path
    text: str
    textures: TextureBytes


_LONG_KEY = re.compile(
    rf"""(?<![\w-])(?:(?>[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){{{TOML_KEY_PARTS_MAX}}}""", re.ASCII
)
"""Matches a dotted key with more than `TOML_KEY_PARTS_MAX` parts, which is refused before tomllib parses the file."""


class TomlTable:
    """A table of a TOML file together with its position in the file, which error messages name."""

    def __init__(self, values: dict[str, Any], source: _Source, where: KeyPath = ()) -> None:
        self.values = values
        self._source = source
        self._where = where

    @classmethod
    def read(cls, path: PathLike, kind: str) -> TomlTable:
        """Reads the top-level table of a file.

        Args:
            path: The file.
            kind: Expected kind of file for error messages, such as ``"a scene file"``.

        Raises:
            FormatError: The file cannot be read, or is not TOML.
        """
        try:
            text = read_text(path)
            if long := _LONG_KEY.search(text):
                line = text.count("\n", 0, long.start()) + 1
                raise FormatError(path, f"line {line}: a dotted key has more than {TOML_KEY_PARTS_MAX} parts")
            return cls(tomllib.loads(text), _Source(Path(path), text, TextureBytes(path)))
        except tomllib.TOMLDecodeError as error:
            raise FormatError(path, f"is not valid TOML: {error}") from None
        except (UnicodeDecodeError, RecursionError):
            raise FormatError(path, f"is not {kind}: expected TOML text") from None
        except FormatError:
            raise
        except ValueError:  # Python's limit of 4,300 digits for an integer
            raise FormatError(path, f"is not {kind}: it holds an integer of thousands of digits") from None

    @classmethod
    def of(cls, path: Path, values: dict[str, Any], *where: str) -> TomlTable:
        """Creates a table in memory, as if it were part of a file.

        Args:
            path: File that the table belongs to; relative paths start from the file's folder.
            values: Values of the table.
            *where: Keys that lead to the table, for error messages.
        """
        return cls(values, _Source(path, "", TextureBytes(path)), where)

    def with_values(self, values: dict[str, Any]) -> TomlTable:
        """Returns a table with other values whose errors name the position of this one."""
        return TomlTable(values, self._source, self._where)

    @property
    def path(self) -> Path:
        """Path of the file that the table belongs to."""
        return self._source.path

    @property
    def textures(self) -> TextureBytes:
        """Byte counter that limits the total size of all textures that this file names."""
        return self._source.textures

    @property
    def is_of_file(self) -> bool:
        """True for a table that was read from a file, False for a table that `TomlTable.of` created in memory."""
        return bool(self._source.text)

    def error(self, problem: str, key: str | None = None) -> FormatError:
        """Creates an error that names file, line and table, about a key or, if ``key`` is None, the whole table."""
        lines = line_numbers(self._source.text)
        where = (*self._where, key) if key is not None else self._where
        while where and where not in lines:
            where = where[:-1]
        label = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self._where).lstrip(".")
        location = f"line {lines[where]}{label and ', ' + label}: " if where else ""
        return FormatError(self.path, location + problem)

    def failed(self, error: LumisplatError) -> FormatError:
        """Creates a `FormatError` with the text of ``error``, which a class raised for values of this table.

        The text may mention keys of the table; the message names the line of the first of these keys.
        """
        named = (word for word in re.findall(r"\w+", str(error)) if word in self.values)
        return self.error(str(error), next(named, None))

    def wrong(self, key: str, expected: str) -> FormatError:
        """Creates an error about the value of a key: "KEY is VALUE, expected ..."."""
        return self.error(f"{key} is {_quote(self.values[key])}, expected {expected}", key)

    def take(self, known: Mapping[str, Kind], required: Iterable[str] = ()) -> Values:
        """Returns the values of the table by key, after checking the keys and the types of the values.

        Args:
            known: Allowed keys with their kinds.
            required: Keys that must be present.

        Raises:
            FormatError: A key is unknown or missing, or its value is of another kind.
        """
        self.check_keys(known)
        for key in required:
            if key not in self.values:
                raise self.error(f"lacks {key}, {known[key].expected}")
        for key, value in self.values.items():
            if not known[key].accepts(value):
                raise self.wrong(key, known[key].expected)
        return dict(self.values)

    def check_keys(self, known: Iterable[str]) -> None:
        """Checks that the table has only keys that are in ``known``.

        Raises:
            FormatError: Another key is present; the message suggests the most similar allowed key.
        """
        for key in self.values:
            if key not in known:
                raise self.error(f"unknown {key!r}, {suggestion(key, known)}", key)

    def table(self, key: str) -> TomlTable:
        """Returns the subtable of a key, or an empty table if the key is missing.

        Raises:
            FormatError: The value is not a table.
        """
        values = self.values.get(key, {})
        if _is_array_of_tables(values):
            raise self.error(f"{key} may appear only once: write it with single brackets, [{key}]", key)
        if not is_object(values):
            raise self.wrong(key, f"a table, [{key}]")
        return TomlTable(values, self._source, (*self._where, key))

    def tables(self, key: str) -> list[TomlTable]:
        """Returns the elements of an array of tables, or an empty list if the key is missing.

        Raises:
            FormatError: The value is not an array of tables.
        """
        entries = self.values.get(key, [])
        if not _is_array_of_tables(entries):
            raise self.error(f"{key} must be written with double brackets: [[{key}]]", key)
        return [TomlTable(entry, self._source, (*self._where, key, index)) for index, entry in enumerate(entries)]

    def file(self, key: str) -> Path:
        """Returns the path that is the value of a key, relative to the folder of this file.

        Raises:
            FormatError: There is no such file, or it is a device, a pipe or a socket.
        """
        path = named_path(self.path.parent, self.values[key])
        if not path.exists():
            raise self.error(f"{key} is {self.values[key]!r}, no such file", key)
        if not (path.is_file() or path.is_dir()):
            raise self.error(f"{key} is {self.values[key]!r}: a device, a pipe or a socket, expected a file", key)
        return path


def _quote(value: object) -> str:
    """Formats a value for a one-line message, in TOML notation."""
    if isinstance(value, bool):
        return str(value).lower()
    return " ".join(reprlib.repr(value).split())


def plain_value(value: object) -> Any:
    """Converts a value to TOML types: NumPy to Python numbers, tuples to lists, paths and enums to text."""
    match value:
        case Enum():
            return plain_value(value.value)
        case os.PathLike():
            return os.fspath(cast("os.PathLike[str]", value))
        case np.generic() | np.ndarray():
            return cast(Any, value).tolist()
        case Mapping():
            return {name: plain_value(item) for name, item in cast(Mapping[str, object], value).items()}
        case list() | tuple():
            return [plain_value(item) for item in cast(Sequence[object], value)]
        case _:
            return value


def toml_text(values: Mapping[str, Any]) -> str:
    """Formats a document: values first, then tables, then arrays of tables. Arrays of numbers stay on one line."""
    import tomlkit  # takes 20 ms to import, and reading does not need it

    return tomlkit.dumps(plain_value(values))


_KINDS: dict[str, Kind] = {
    "vector": VECTOR,
    "color": COLOR,
    "number": NUMBER,
    "whole": WHOLE,
    "flag": FLAG,
    "text": TEXT,
    "choice": TEXT,
}
_FIELD_KINDS = {"rotation_wxyz": QUATERNION, "texture_wraps": TABLE}
"""TOML types of two fields whose Python types have no entry in `_KINDS`. All other such fields are images, given by
file name."""

DEGREES = "_degrees"
"""Ending of keys for angles. For example, the key ``outer_angle_degrees`` is in degrees, and its dataclass field
``outer_angle`` in radians.
"""


def key_of(field: Setting | Field[Any]) -> str:
    """Returns the scene file key of a dataclass field: its name, with ``_degrees`` added for angles."""
    return field.name + (DEGREES if field.name.endswith("angle") else "")


def schema(kind: type) -> dict[str, Kind]:
    """Returns the keys of a scene file table for a scene dataclass, each with its expected type."""
    return {key_of(one): _KINDS.get(one.kind, _FIELD_KINDS.get(one.name, TEXT)) for one in settings_of(kind)}


def required_keys(kind: type) -> list[str]:
    """Returns the keys of a scene dataclass that have no default."""
    return [key_of(one) for one in settings_of(kind) if one.default is MISSING]


def with_radians(table: TomlTable, values: Mapping[str, Any], largest: float = 90.0) -> Values:
    """Renames keys to field names, and converts angles from degrees to radians.

    Args:
        table: The table, for error messages.
        values: Values by key.
        largest: Largest allowed angle, degrees.

    Raises:
        FormatError: An angle is not within 0..``largest`` degrees.
    """
    named: Values = {}
    for key, value in values.items():
        if not key.endswith(DEGREES):
            named[key] = value
        elif 0.0 <= value <= largest:
            named[key.removesuffix(DEGREES)] = math.radians(value)
        else:
            raise table.error(f"{key} is {value}, expected 0 to {largest:g} degrees", key)
    return named
