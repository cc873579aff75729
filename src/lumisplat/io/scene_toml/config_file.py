"""Settings of the renderer in TOML: the ``[render]`` table of a scene file, with a table below it for each stage.

[render]
pipeline = "hybrid"             # an enum by its value
lighting = "auto"               # None by a word: "auto", of the background "none"
samples = 16

[render.shadow_rays]
color_strength = 1.0
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.config.renamed import RENAMED
from lumisplat.errors import ConfigError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.toml_table import FLAG, TABLE, TomlTable, suggestion

_Config = TypeVar("_Config")

_NOTHING = {"background": "none"}
"""How None is written, by setting; "auto" for all others."""

_TABLE_OF = {"RenderConfig": "render", "AvatarLightingConfig": "animation.lighting"}
"""The table of a scene file that holds the fields of a class."""


def read_config(document: TomlTable) -> RenderConfig:
    """The settings of a scene file; the defaults where it says nothing.

    Raises:
        FormatError: An unknown setting, or a bad value.
    """
    return read_settings(document.table("render"), RenderConfig)


def write_config(path: PathLike, config: RenderConfig) -> None:
    """Writes every setting; see `lumisplat.io.save_config`."""
    if not isinstance(config, RenderConfig):
        raise ConfigError(f"config is a {type(config).__name__}, expected a RenderConfig")
    text = "\n".join(_lines(config, "render")) + "\n"
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def read_settings(table: TomlTable, kind: type[_Config]) -> _Config:
    """The settings of a table, those of stages in tables below it; the defaults where it says nothing.

    Args:
        table: Keys are the names of fields.
        kind: Which settings.

    Raises:
        FormatError: An unknown setting, or a bad value.
    """
    hints = get_type_hints(kind)
    renamed = RENAMED.get(kind.__name__, {})
    for key in table.values:
        if key in renamed:
            raise table.error(f"{key!r} is now {_toml_path(renamed[key])}", key)
    table.check_keys(hints)
    try:
        return kind(**{key: _setting(table, key, hints[key]) for key in table.values})
    except ConfigError as error:
        raise table.failed(error) from None


def _setting(table: TomlTable, key: str, hint: Any) -> Any:
    """The value of a key; what is of the right kind and out of its range is for the settings to refuse."""
    value = table.values[key]
    nothing = _NOTHING.get(key, "auto") if isinstance(hint, types.UnionType) else ""
    if nothing:
        if value == nothing:
            return None
        (hint,) = (one for one in get_args(hint) if one is not types.NoneType)
    if isinstance(hint, type) and is_dataclass(hint):
        if not TABLE.accepts(value):
            raise table.wrong(key, TABLE.expected)
        return read_settings(table.table(key), hint)
    if hint is bool and not FLAG.accepts(value):
        raise table.wrong(key, FLAG.expected + (nothing and f' or "{nothing}"'))
    if isinstance(hint, type) and issubclass(hint, Enum):
        members = {member.value: member for member in hint}
        if not isinstance(value, str):
            raise table.wrong(key, ", ".join(members))
        if value not in members:
            raise table.error(f"{key} is {value!r}, {suggestion(value, members)}", key)
        return members[value]
    return tuple(value) if get_origin(hint) is tuple and isinstance(value, list) else value


def _toml_path(path: str) -> str:
    """A setting as TOML names it: ``render.jitter`` for ``RenderConfig.jitter``."""
    kind, _, field = path.partition(".")
    return f"{_TABLE_OF[kind]}.{field}"


def _lines(config: Any, name: str) -> Iterator[str]:
    """A table of all settings, those of its stages in tables behind it."""
    stages = []
    yield f"[{name}]"
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            stages.append(field.name)
        else:
            yield f"{field.name} = {_toml(_NOTHING.get(field.name, 'auto') if value is None else value)}"
    for stage in stages:
        yield ""
        yield from _lines(getattr(config, stage), f"{name}.{stage}")


def _toml(value: Any) -> str:
    match value:
        case Enum():
            return f'"{value.value}"'
        case str():
            return f'"{value}"'
        case bool() | np.bool_():
            return str(bool(value)).lower()
        case tuple():
            return f"[{', '.join(map(_toml, value))}]"
    return repr(value.item() if isinstance(value, np.generic) else value)
