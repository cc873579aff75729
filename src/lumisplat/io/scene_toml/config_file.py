"""Reads and writes render settings in TOML: the ``[render]`` table of a scene file, with one subtable for each stage.

[render]
pipeline = "hybrid"             # an enum is written as its value
lighting = "auto"               # None is written as "auto", or "none" for a colour; flags also take "on" and "off"
samples = 16

[render.shadow_rays]
color_strength = 1.0
"""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from lumisplat.config import RenderConfig
from lumisplat.config.checks import RENAMED_SETTINGS
from lumisplat.config.setting import Setting, all_settings, settings_of
from lumisplat.errors import ConfigError, FormatError
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.io.scene_toml.toml_table import FLAG, TABLE, TomlTable, suggestion, toml_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Config = TypeVar("_Config")

_FLAG_WORDS = {"on": True, "off": False}
"""Words for a setting that is True, False or None, as on the command line: ``--lighting off``."""


def read_config(document: TomlTable) -> RenderConfig:
    """Reads the render settings of a scene file; missing settings get their defaults.

    Raises:
        FormatError: A setting is unknown, or its value is invalid.
    """
    return read_settings(document.table("render"), RenderConfig)


def write_config(path: PathLike, config: RenderConfig) -> None:
    """Writes all render settings to a TOML file; see `lumisplat.io.save_config`.

    Raises:
        ConfigError: ``config`` is not a `RenderConfig`.
        FormatError: The file cannot be written.
    """
    if not isinstance(config, RenderConfig):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ConfigError(f"config is a {type(config).__name__}, expected a RenderConfig")
    text = toml_text({"render": _table(config)})
    with atomic_write(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def read_settings(table: TomlTable, kind: type[_Config], base: _Config | None = None) -> _Config:
    """Reads settings from a table, and groups of settings from its subtables.

    Args:
        table: Table whose keys are field names of ``kind``.
        kind: Dataclass of the settings.
        base: Settings to use for missing keys; None uses the defaults.

    Raises:
        FormatError: A setting is unknown, or its value is invalid.
    """
    declared = {one.name: one for one in settings_of(kind)}
    table.check_keys(declared)
    try:
        values = {key: _setting(table, declared[key], getattr(base, key, None)) for key in table.values}
        return kind(**values) if base is None else replace(cast(Any, base), **values)
    except ConfigError as error:
        raise table.failed(error) from None


def changed_setting(base: _Config, name: str, text: str) -> _Config:
    """Returns a copy of the settings with one setting changed; see `lumisplat.io.change_config`.

    Raises:
        ConfigError: There is no such setting, or its value is invalid.
    """
    try:
        value: object = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    known = [*all_settings(type(base))]
    *groups, key = name.split(".")
    if name not in known:
        if inside := [other for other in known if other.startswith(f"{name}.")]:
            listed = ", ".join(inside[:3])
            raise ConfigError(f"'{name}' is a group of settings, such as {listed}: docs/settings.md lists all")
        raise ConfigError(f"there is no setting '{name}'{_hint(name, known)}")
    values = {key: value}
    for group in reversed(groups):
        values = {group: values}
    try:
        return read_settings(TomlTable.of(Path(name), values), type(base), base)
    except FormatError as error:
        raise ConfigError(str(error).removeprefix(f"{name}: ")) from None


def _hint(name: str, known: Sequence[str]) -> str:
    """Returns the end of an error about an unknown setting: its new name, similar ones, or the page that lists all."""
    group, _, key = name.rpartition(".")
    renamed = ".".join(filter(None, (group, RENAMED_SETTINGS.get(key))))
    if renamed in known:
        return f", it is called '{renamed}' now"
    last_names = {other.rpartition(".")[2] for other in known}
    near = {key} & last_names or {*difflib.get_close_matches(key, last_names, 1, 0.75)}
    similar = difflib.get_close_matches(name, known, 1) if "." in name else []
    similar = similar or [other for other in known if other.rpartition(".")[2] in near]
    return f", did you mean {' or '.join(similar[:3])}?" if similar else ": docs/settings.md lists all"


def _setting(table: TomlTable, setting: Setting, base: object) -> object:
    """Converts the TOML value of a setting to its Python type. Ranges are checked later, by the settings class.

    ``base`` is the setting's previous value; a group of settings takes missing keys from it.
    """
    key, value = setting.name, table.values[setting.name]
    none = _word_for_none(setting) if setting.is_optional else ""
    if none and value == none:
        return None
    match setting.kind:
        case "group":
            if not TABLE.accepts(value):
                raise table.wrong(key, TABLE.expected)
            assert setting.group is not None
            return read_settings(table.table(key), setting.group, cast(Any, base))
        case "flag":
            if none and isinstance(value, str):
                value = _FLAG_WORDS.get(value, value)
            if not FLAG.accepts(value):
                raise table.wrong(key, FLAG.expected + (none and f', as words "on" or "off", or "{none}"'))
            return value
        case "choice":
            return _enum_member(table, setting)
        case "color" | "vector" | "span" | "names":
            return tuple(cast(list[object], value)) if isinstance(value, list) else value
        case _:
            return value


def _word_for_none(setting: Setting) -> str:
    """Returns the word that stands for the setting's value None, because TOML has no null."""
    return "none" if setting.kind == "color" else "auto"


def _enum_member(table: TomlTable, setting: Setting) -> Enum:
    """Returns the enum member whose value the table gives for the setting."""
    key, value = setting.name, table.values[setting.name]
    members = {str(member.value): member for member in setting.choices}
    if not isinstance(value, str):
        raise table.wrong(key, ", ".join(members))
    if value not in members:
        raise table.error(f"{key} is {value!r}, {suggestion(value, members)}", key)
    return members[value]


def changed_settings(config: DataclassInstance) -> dict[str, Any]:
    """Returns the settings that differ from their defaults, as nested TOML tables."""
    return _table(config, type(config)())


def _table(config: object, base: object = None) -> dict[str, Any]:
    """Converts settings to nested TOML tables; with ``base``, only settings that differ from ``base`` are included."""
    table: dict[str, Any] = {}
    for one in settings_of(type(config)):
        value, before = getattr(config, one.name), getattr(base, one.name, None)
        if one.kind == "group":
            if group := _table(value, before):
                table[one.name] = group
        elif base is None or value != before:
            table[one.name] = _toml_value(one, value)
    return table


def _toml_value(setting: Setting, value: object) -> object:
    """Converts the value of a setting to a TOML value."""
    if value is None:
        return _word_for_none(setting)
    if isinstance(value, tuple):
        return list(cast(tuple[object, ...], value))
    return value.value if isinstance(value, Enum) else value
