"""Tables as TOML text, which ``tomllib`` reads back to equal values."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, cast

import numpy as np

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_LINE_VALUES_MAX = 100
"""Characters of tables in one line; longer ones have a heading of their own where they can."""


def plain_value(value: object) -> Any:
    """A value as TOML has it: numbers of NumPy as Python's, arrays and tuples as lists, paths and enums as texts."""
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
    """A document: values first, then tables, then arrays of tables."""
    return "\n".join(_table_lines(values, ())).strip("\n") + "\n"


def toml_value(value: object) -> str:  # noqa: PLR0911
    """A value as TOML writes it."""
    match value:
        case Enum():
            return toml_value(value.value)
        case str():
            return _quoted(value)
        case bool() | np.bool_():
            return str(bool(value)).lower()
        case np.generic():
            return toml_value(cast(object, value.item()))  # a number of NumPy as Python writes it
        case Mapping():
            pairs = cast(Mapping[str, object], value).items()
            return f"{{ {', '.join(f'{_key(name)} = {toml_value(item)}' for name, item in pairs)} }}" if value else "{}"
        case list() | tuple():
            return f"[{', '.join(map(toml_value, cast(Sequence[object], value)))}]"
        case _:
            return repr(value)  # numbers; inf and nan are written alike


def _table_lines(values: Mapping[str, Any], where: tuple[str, ...]) -> Iterator[str]:
    """The lines of a table's contents; headings name all the tables around them."""
    below: list[tuple[str, Any]] = []
    for name, value in values.items():
        if _is_below(value, where):
            below.append((name, value))
        else:
            yield f"{_key(name)} = {toml_value(value)}"
    for name, value in below:
        place = (*where, name)
        heading = ".".join(map(_key, place))
        tables = cast(list[Mapping[str, Any]], value if isinstance(value, list) else [value])
        for table in tables:
            yield ""
            yield f"[[{heading}]]" if isinstance(value, list) else f"[{heading}]"
            yield from _table_lines(table, place)


def _is_below(value: object, where: tuple[str, ...]) -> bool:
    """Whether a value has a heading: an array of tables, and a table at the top, of tables, or too long for a line."""
    if isinstance(value, list):
        items = cast(list[object], value)
        return bool(items) and all(isinstance(item, Mapping) for item in items)
    if not isinstance(value, Mapping):
        return False
    held = cast(Mapping[str, object], value).values()
    return (
        not where
        or any(isinstance(item, Mapping) for item in held)
        or len(toml_value(cast(object, value))) > _LINE_VALUES_MAX
    )


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else _quoted(name)


def _quoted(text: str) -> str:
    """A text in quotes. JSON escapes what TOML wants escaped, but for one character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
