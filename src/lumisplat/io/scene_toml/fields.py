"""Objects of the scene from tables of a scene file: keys are the names of their fields, angles are in degrees."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from typing import Any

from lumisplat.io.scene_toml.toml_table import COLOR, FLAG, NUMBER, QUATERNION, TEXT, VECTOR, Kind, TomlTable

_KINDS = {
    "Vector": VECTOR,
    "Color": COLOR,
    "float": NUMBER,
    "bool": FLAG,
    "str": TEXT,
    "npt.ArrayLike": QUATERNION,
    "Texture | None": TEXT,
    "FloatArray | None": TEXT,
}
"""By the annotation of a field; images are the names of files."""

DEGREES = "_degrees"
"""Ends the keys of angles, whose fields are in radians."""


def key_of(field: Field[Any]) -> str:
    """The key of a field."""
    return field.name + (DEGREES if field.name.endswith("angle") else "")


def schema(kind: type) -> dict[str, Kind]:
    """The keys that a dataclass of the scene has in a scene file."""
    return {key_of(field): _KINDS[str(field.type)] for field in fields(kind)}


def required_keys(kind: type) -> list[str]:
    """Those of its keys that have no default."""
    return [key_of(field) for field in fields(kind) if field.default is MISSING]


def with_radians(table: TomlTable, values: Mapping[str, Any], largest: float = 90.0) -> dict[str, Any]:
    """Values by the names of fields, angles in radians.

    Raises:
        FormatError: An angle is not within 0..``largest`` degrees.
    """
    named = {}
    for key, value in values.items():
        if key.endswith(DEGREES):
            if not 0.0 <= value <= largest:
                raise table.error(f"{key} is {value}, expected 0 to {largest:g} degrees", key)
            value = math.radians(value)  # noqa: PLW2901
        named[key.removesuffix(DEGREES)] = value
    return named
