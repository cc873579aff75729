"""Reads the lights and the environment of a scene file.

[[lights]]
type = "spot"                       # see the classes of scene/lights.py
position = [0.0, 2.0, 0.0]
direction = [0.0, -1.0, 0.0]
intensity = 40.0                    # candela
outer_angle_degrees = 35.0          # angles are in degrees, from the axis

[environment]
path = "studio.hdr"                 # relative to the scene file
intensity = 0.5
"""

from __future__ import annotations

from typing import TypeVar

from lumisplat.config.checks import suggestion
from lumisplat.errors import SceneError
from lumisplat.io.images.radiance import read_radiance
from lumisplat.io.scene_toml.toml_table import (
    PAIR,
    TEXT,
    VECTOR,
    Kind,
    TomlTable,
    Values,
    required_keys,
    schema,
    with_radians,
)
from lumisplat.scene.lights import LIGHT_KINDS, Light, LightEnvironment, LightSpot

_Light = TypeVar("_Light", bound=Light)

_OTHER_NAMES = {"sun": "directional", "distant": "directional", "area": "rect", "quad": "rect"}
"""Names that other renderers give to light types, each with the scene file's name, for error messages."""


def read_light(table: TomlTable) -> Light:
    """Reads an entry of ``[[lights]]``.

    Raises:
        FormatError: The type or a key is unknown, or a value is invalid.
    """
    name = table.values.get("type")
    kind = LIGHT_KINDS.get(name) if isinstance(name, str) else None
    if name == "environment":
        raise table.error("type is 'environment': write it as a table of its own, [environment]", "type")
    if kind is None:
        hint = f"expected {', '.join(LIGHT_KINDS)}"
        if isinstance(name, str):
            hint = f"did you mean {_OTHER_NAMES[name]!r}?" if name in _OTHER_NAMES else suggestion(name, LIGHT_KINDS)
        raise table.error(f"type is {name!r}, {hint}" if "type" in table.values else f"lacks type, {hint}", "type")
    given = table.take({"type": TEXT, **schema(kind), **_aim_keys(kind)}, _required(kind, table))
    del given["type"]
    values = with_radians(table, given)
    if kind is LightSpot:
        inner, outer = (given.get(f"{side}_angle_degrees", rest) for side, rest in (("inner", 0), ("outer", 45)))
        if not inner < outer:
            key = "inner_angle_degrees" if "inner_angle_degrees" in given else "outer_angle_degrees"
            raise table.error(f"inner_angle_degrees is {inner}, expected less than outer_angle_degrees, {outer}", key)
    return _make(table, kind, values)


def _aim_keys(kind: type[Light]) -> dict[str, Kind]:
    """Returns the keys of a light that may replace ``direction``, such as ``target``, each with its type of value."""
    return {key: PAIR if key == "size" else VECTOR for key in kind.aim_keys}


def _required(kind: type[Light], table: TomlTable) -> list[str]:
    """Returns the keys that a light must have: fields without a default, and ``direction`` unless a key aims it."""
    is_aimed = any(key in table.values for key in kind.aim_keys if key != "size")
    return required_keys(kind) + ([] if is_aimed else list(kind.aim_fields))


def read_environment(table: TomlTable) -> LightEnvironment:
    """Reads ``[environment]``: an environment map, a constant colour, or a map multiplied by a colour.

    Raises:
        FormatError: A key is unknown, a value is invalid, or the image cannot be read.
    """
    keys = schema(LightEnvironment)
    given = table.take({"path": keys.pop("image"), **keys})
    if "path" in given:
        given["image"] = read_radiance(table.file("path"))
        del given["path"]
    return _make(table, LightEnvironment, given)


def _make(table: TomlTable, kind: type[_Light], values: Values) -> _Light:
    """Creates a light from checked values; a value that the light's class refuses is reported with file and line."""
    try:
        return kind(**values)
    except SceneError as error:
        raise table.failed(error) from None
