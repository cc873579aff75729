"""The line numbers of the keys of a TOML text, which tomllib does not give."""

from __future__ import annotations

import re
import tomllib
from typing import NamedTuple

KeyPath = tuple[str | int, ...]
"""Keys and indices from the top of the document, e.g. ``("splats", 1, "position")``."""

_TOKEN = re.compile(
    r"""(?P<blank>[ \t\r]+|\#[^\n]*)
      | (?P<newline>\n)
      | (?P<string>\"{3}(?s:(?:\\.|[^\\])*?)\"{3,5} | '{3}(?s:.*?)'{3,5} | "(?:\\.|[^"\\\n])*" | '[^'\n]*')
      | (?P<mark>[\[\]{}=,.])
      | (?P<bare>[^\s\[\]{}=,.\#"']+)""",
    re.VERBOSE,
)


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


def line_numbers(text: str) -> dict[KeyPath, int]:
    """The line of every key, table and element of an array of tables, counted from 1.

    Args:
        text: Valid TOML, which tomllib has read without an error.
    """
    return _Scanner(text).lines


class _Scanner:
    """Reads the tokens of a text and notes the line of every key."""

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
        """Reads a header after its first bracket: ``[a.b]`` or ``[[a.b]]``."""
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
        """A path, or that of the latest element if it is an array of tables."""
        return (*path, self._array_sizes[path] - 1) if path in self._array_sizes else path

    def _keys(self, end: str) -> tuple[list[str], int]:
        """Reads a dotted key and the mark after it; the line is that of its first part."""
        keys: list[str] = []
        line = self._upcoming.line
        while (token := self._next()).text != end:
            if token.kind == "bare":
                keys.append(token.text)
            elif token.kind == "string":
                keys.append(tomllib.loads(f"key = {token.text}")["key"])
        return keys, line

    def _pair(self, table: KeyPath) -> None:
        """Reads ``key = value``."""
        keys, line = self._keys("=")
        for depth in range(len(keys)):
            self.lines.setdefault((*table, *keys[: depth + 1]), line)
        self._value((*table, *keys))

    def _value(self, path: KeyPath) -> None:
        token = self._next()
        if token.text in ("[", "{"):
            self._members(path, "]" if token.text == "[" else "}")
        elif token.kind != "string":  # a number or a date: bare parts with dots in between
            while self._upcoming.kind == "bare" or self._upcoming.text == ".":
                self._at += 1

    def _members(self, path: KeyPath, end: str) -> None:
        """Reads the contents of an array or an inline table, and its end."""
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
