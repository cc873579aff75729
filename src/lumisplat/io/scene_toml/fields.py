"""Scene dataclasses from tables of a scene file: keys are the names of fields, angles are in degrees."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field
from typing import Any

from lumisplat.config.setting import Setting, settings_of
from lumisplat.io.scene_toml.toml_table import (
    COLOR,
    FLAG,
    NUMBER,
    QUATERNION,
    TABLE,
    TEXT,
    VECTOR,
    WHOLE,
    Kind,
    TomlTable,
    Values,
)

_KINDS: dict[str, Kind] = {
    "vector": VECTOR,
    "color": COLOR,
    "number": NUMBER,
    "whole": WHOLE,
    "flag": FLAG,
    "text": TEXT,
    "choice": TEXT,
}
_OTHERS = {"rotation_wxyz": QUATERNION, "texture_wraps": TABLE}
"""Kinds of values by that of a field; other fields are images, given by file names."""

DEGREES = "_degrees"
"""End of the keys of angles, whose fields are in radians."""


def key_of(field: Setting | Field[Any]) -> str:
    """The key of a field."""
    return field.name + (DEGREES if field.name.endswith("angle") else "")


def schema(kind: type) -> dict[str, Kind]:
    """The keys of a scene dataclass in a scene file, with their kinds."""
    return {key_of(one): _KINDS.get(one.kind, _OTHERS.get(one.name, TEXT)) for one in settings_of(kind)}


def required_keys(kind: type) -> list[str]:
    """The keys of a scene dataclass that have no default."""
    return [key_of(one) for one in settings_of(kind) if one.default is MISSING]


def with_radians(table: TomlTable, values: Mapping[str, Any], largest: float = 90.0) -> Values:
    """Values by the names of fields, with angles in radians.

    Args:
        table: The table, for errors.
        values: Values by key.
        largest: Largest angle, degrees.

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
