"""TOML tables whose values are taken by kind; what is wrong is said with its line, its key and what was meant."""

from __future__ import annotations

import difflib
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from lumisplat.errors import FormatError, LumisplatError
from lumisplat.io.files.source import PathLike, read_bytes
from lumisplat.io.scene_toml.toml_lines import KeyPath, line_numbers


class Kind(NamedTuple):
    """What a value may be."""

    expected: str
    """For messages: ``three numbers``."""
    accepts: Callable[[Any], bool]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _numbers(count: int) -> Callable[[object], bool]:
    return lambda value: isinstance(value, list) and len(value) == count and all(map(_is_number, value))


TEXT = Kind("a string", lambda value: isinstance(value, str))
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
NUMBER = Kind("a number", _is_number)
WHOLE = Kind("a whole number", lambda value: isinstance(value, int) and not isinstance(value, bool))
VECTOR = Kind("three numbers", _numbers(3))
QUATERNION = Kind("four numbers, w x y z", _numbers(4))
COLOR = Kind("a number or three", lambda value: _is_number(value) or _numbers(3)(value))
TABLE = Kind("a table", lambda value: isinstance(value, dict))
TABLES = Kind(
    "tables, written with double brackets",
    lambda value: isinstance(value, list) and all(isinstance(entry, dict) for entry in value),
)
TEXT_OR_TABLE = Kind("a name or a table", lambda value: isinstance(value, str | dict))


class _Text(NamedTuple):
    path: Path
    text: str


class TomlTable:
    """A table of a TOML file, and where in the file it is."""

    def __init__(self, values: dict[str, Any], source: _Text, where: KeyPath = ()) -> None:
        self.values = values
        self._source = source
        self._where = where

    @classmethod
    def read(cls, path: PathLike, kind: str) -> TomlTable:
        """The top of a file.

        Args:
            path: What to read.
            kind: What it should be, for messages: ``"a scene file"``.

        Raises:
            FormatError: The file cannot be read, or is not TOML.
        """
        try:
            text = read_bytes(path).decode("utf-8-sig")
            return cls(tomllib.loads(text), _Text(Path(path), text))
        except tomllib.TOMLDecodeError as error:
            raise FormatError(path, f"is not valid TOML: {error}") from None
        except (UnicodeDecodeError, RecursionError):
            raise FormatError(path, f"is not {kind}: expected TOML text") from None

    @property
    def path(self) -> Path:
        """The file."""
        return self._source.path

    def error(self, problem: str, key: str | None = None) -> FormatError:
        """An error about a key of this table, or about all of it: names the file, the line and the table."""
        lines = line_numbers(self._source.text)
        where = (*self._where, key) if key is not None else self._where
        while where and where not in lines:
            where = where[:-1]
        label = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in self._where).lstrip(".")
        place = f"line {lines[where]}{label and ', ' + label}: " if where else ""
        return FormatError(self.path, place + problem)

    def failed(self, error: LumisplatError) -> FormatError:
        """What an object made of this table found wrong: at the line of the key that its message names first."""
        named = (word for word in re.findall(r"\w+", str(error)) if word in self.values)
        return self.error(str(error), next(named, None))

    def wrong(self, key: str, expected: str) -> FormatError:
        """An error about the value of a key."""
        return self.error(f"{key} is {_told(self.values[key])}, expected {expected}", key)

    def take(self, known: Mapping[str, Kind], required: Iterable[str] = ()) -> dict[str, Any]:
        """The values, all of them of the kinds that are known.

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
        """Refuses keys that are not known, with the nearest one that is.

        Raises:
            FormatError: A key is unknown.
        """
        for key in self.values:
            if key not in known:
                raise self.error(f"unknown {key!r}, {suggestion(key, known)}", key)

    def table(self, key: str) -> TomlTable:
        """The table of a key; an empty one where there is none.

        Raises:
            FormatError: The value is no table.
        """
        values = self.values.get(key, {})
        if isinstance(values, list) and all(isinstance(value, dict) for value in values):
            raise self.error(f"{key} is there once only: write it with single brackets, [{key}]", key)
        if not isinstance(values, dict):
            raise self.wrong(key, f"a table, [{key}]")
        return TomlTable(values, self._source, (*self._where, key))

    def tables(self, key: str) -> list[TomlTable]:
        """The elements of an array of tables; none where there is none.

        Raises:
            FormatError: The value is no such array.
        """
        entries = self.values.get(key, [])
        if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
            raise self.error(f"{key} must be written with double brackets: [[{key}]]", key)
        return [TomlTable(entry, self._source, (*self._where, key, index)) for index, entry in enumerate(entries)]

    def file(self, key: str) -> Path:
        """The file that a key names, relative to this one.

        Raises:
            FormatError: There is none.
        """
        path = self.path.parent / self.values[key]
        if not path.exists():
            raise self.error(f"{key} is {self.values[key]!r}, no such file", key)
        return path


def suggestion(name: str, known: Iterable[str]) -> str:
    """What was meant by an unknown name, else all that is known."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else f"expected {', '.join(known)}"


def _told(value: object) -> str:
    """A value in a message of one line, as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return " ".join(reprlib.repr(value).split())
