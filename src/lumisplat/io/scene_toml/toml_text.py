"""Writes tables as TOML text, which ``tomllib`` reads back to equal values."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, cast

import numpy as np


def plain_value(value: object) -> Any:
    """Converts a value to what TOML has: NumPy to Python, tuples to lists, paths and enums to text."""
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
    """Writes a document: values first, then tables, then arrays of tables; arrays of numbers stay on one line."""
    import tomlkit  # 20 ms that readers need not wait for

    return tomlkit.dumps(plain_value(values))
