"""Settings of the renderer in TOML: the ``[render]`` table of a scene file, with a table below it for each stage.

[render]
pipeline = "hybrid"             # an enum by its value
lighting = "auto"               # None by a word: "auto", of the background "none"; else true, false, "on" or "off"
samples = 16

[render.shadow_rays]
color_strength = 1.0
"""

from __future__ import annotations

import types
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast, get_args, get_origin, get_type_hints

from lumisplat.config import RenderConfig
from lumisplat.errors import ConfigError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.toml_table import FLAG, TABLE, TomlTable, suggestion
from lumisplat.io.scene_toml.toml_text import toml_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Config = TypeVar("_Config")

_WORD_FOR_NONE = {"background": "none"}
"""How None is written, by setting; "auto" for all others."""

_SWITCH = {"on": True, "off": False}
"""Words for a flag that may be None, as the shell has them: ``--lighting off``."""


def read_config(document: TomlTable) -> RenderConfig:
    """The settings of a scene file; defaults for those that it does not name.

    Raises:
        FormatError: An unknown setting, or a bad value.
    """
    return read_settings(document.table("render"), RenderConfig)


def write_config(path: PathLike, config: RenderConfig) -> None:
    """Writes every setting; see `lumisplat.io.save_config`.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        FormatError: The file cannot be written.
    """
    if not isinstance(config, RenderConfig):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigError(f"config is a {type(config).__name__}, expected a RenderConfig")
    text = toml_text({"render": _all_settings(config)})
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def read_settings(table: TomlTable, kind: type[_Config]) -> _Config:
    """The settings of a table, those of groups in tables below it; defaults for those that it does not name.

    Args:
        table: Its keys are names of fields.
        kind: The class of the settings.

    Raises:
        FormatError: An unknown setting, or a bad value.
    """
    hints = get_type_hints(kind)
    table.check_keys(hints)
    try:
        return kind(**{key: _setting(table, key, hints[key]) for key in table.values})
    except ConfigError as error:
        raise table.failed(error) from None


def _setting(table: TomlTable, key: str, hint: object) -> object:
    """The value of a key, of the type that ``hint`` names; whether it is in its range is checked by the settings."""
    value = table.values[key]
    none = _WORD_FOR_NONE.get(key, "auto") if isinstance(hint, types.UnionType) else ""
    if none:
        if value == none:
            return None
        (hint,) = (one for one in get_args(hint) if one is not types.NoneType)
    if isinstance(hint, type) and is_dataclass(hint):
        if not TABLE.accepts(value):
            raise table.wrong(key, TABLE.expected)
        return read_settings(table.table(key), hint)
    if hint is bool and none and isinstance(value, str):
        value = _SWITCH.get(value, value)
    if hint is bool and not FLAG.accepts(value):
        raise table.wrong(key, FLAG.expected + (none and f', as words "on" or "off", or "{none}"'))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _member(table, key, hint)
    return tuple(cast(list[object], value)) if get_origin(hint) is tuple and isinstance(value, list) else value


def _member(table: TomlTable, key: str, kind: type[Enum]) -> Enum:
    """The member of an enum that a key names by its value."""
    value = table.values[key]
    members = {str(member.value): member for member in kind}
    if not isinstance(value, str):
        raise table.wrong(key, ", ".join(members))
    if value not in members:
        raise table.error(f"{key} is {value!r}, {suggestion(value, members)}", key)
    return members[value]


def _all_settings(config: DataclassInstance) -> dict[str, Any]:
    """Returns every setting as a table of a scene file has it, those of groups in tables."""
    values = {field.name: getattr(config, field.name) for field in fields(config)}
    return {
        name: _all_settings(cast(Any, value)) if is_dataclass(value) else _written(name, value)
        for name, value in values.items()
    }


def changed_settings(config: DataclassInstance) -> dict[str, Any]:
    """The settings that differ from the defaults, as a table of a scene file has them; those of groups in tables."""
    base = type(config)()
    table: dict[str, Any] = {}
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value) and not isinstance(value, type):
            if changes := changed_settings(value):
                table[field.name] = changes
        elif value != getattr(base, field.name):
            table[field.name] = _written(field.name, value)
    return table


def _written(name: str, value: object) -> object:
    """The value of a setting as a table has it."""
    if value is None:
        return _WORD_FOR_NONE.get(name, "auto")
    if isinstance(value, tuple):
        return list(cast(tuple[object, ...], value))
    return value.value if isinstance(value, Enum) else value
