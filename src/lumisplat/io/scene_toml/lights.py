"""Reads the lights and the environment of a scene file.

[[lights]]
type = "spot"                       # see the classes of scene/lights.py
position = [0.0, 2.0, 0.0]
direction = [0.0, -1.0, 0.0]
intensity = 40.0                    # candela
outer_angle_degrees = 35.0          # angles are in degrees, from the axis

[[lights.keyframes]]                # the light changes with time; missing keys are inherited from the one before
time = 0.0

[[lights.keyframes]]
time = 2.0
position = [1.0, 2.0, 0.0]

[environment]
path = "studio.hdr"                 # relative to the scene file
intensity = 0.5

[sun]                               # sun and clear sky, instead of [environment]
latitude = 48.1
longitude = 11.6
time = 2026-06-21T18:30:00+02:00    # or as text
speed = 1800.0                      # the clock advances by half an hour in a second of the animation
"""

from __future__ import annotations

from datetime import datetime
from typing import TypeVar

from lumisplat.config.checks import suggestion
from lumisplat.errors import SceneError
from lumisplat.io.images.radiance import read_radiance
from lumisplat.io.scene_toml.keyframes import KEYFRAMES, read_keyframes
from lumisplat.io.scene_toml.placement import DIRECTION
from lumisplat.io.scene_toml.toml_table import (
    FLAG,
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
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.animation.daylight import Daylight
from lumisplat.scene.animation.lights import LightPath, MovingLight
from lumisplat.scene.checks import with_checked
from lumisplat.scene.lights import LIGHT_KINDS, Light, LightEnvironment, LightSpot, PlacedLight
from lumisplat.scene.placing import Vector

_Light = TypeVar("_Light", bound=Light)

_OTHER_NAMES = {"sun": "directional", "distant": "directional", "area": "rect", "quad": "rect"}
"""Names that other renderers give to light types, each with the scene file's name, for error messages."""


_CONSTANT = ("enabled", "casts_shadow", "visible", "name", "path", "image", "shadow_distance")
"""Keys of a light or environment that keyframes cannot change."""


def read_light(table: TomlTable) -> Light | LightPath:
    """Reads an entry of ``[[lights]]``; one with keyframes becomes a path.

    Raises:
        FormatError: The type or a key is unknown, or a value is invalid.
    """
    kind = _kind_of(table)
    if "keyframes" not in table.values:
        return _read_still(table, kind)
    aims, fields = {*kind.aim_keys}, {*kind.aim_fields}
    keys = {key: value for key, value in (schema(kind) | _aim_keys(kind)).items() if key not in _CONSTANT}

    def inherited(given: Values, last: Values) -> Values:
        """Drops the aim of the keyframe before if a keyframe aims in another way."""
        dropped = fields if aims & given.keys() else aims if fields & given.keys() else set[str]()
        return {key: value for key, value in last.items() if key not in dropped} | given

    times, tables = read_keyframes(table, keys, inherited)
    lights = [_read_still(entry, kind) for entry in tables]
    targets = None
    if isinstance(lights[0], PlacedLight) and all("target" in entry.values for entry in tables):
        targets = [entry.values["target"] for entry in tables]
    return _path(table, lights, times, targets)


def _path(table: TomlTable, lights: list[Light], times: list[float], targets: list[list[float]] | None) -> LightPath:
    """Creates a path; a problem of the lights together is reported with the line of the entry."""
    try:
        return LightPath(lights, times, targets)
    except SceneError as error:
        raise table.failed(error) from None


def _kind_of(table: TomlTable) -> type[Light]:
    """Returns the class of a light by its ``type``.

    Raises:
        FormatError: The type is missing or unknown.
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
    return kind


def _read_still(table: TomlTable, kind: type[Light]) -> Light:
    """Reads a light of a class from an entry without keyframes."""
    keys = {"type": TEXT, **schema(kind), **_aim_keys(kind)}
    table.check_keys([*keys, "keyframes"])  # suggests keyframes, too
    given = table.take(keys, _required(kind, table))
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


def read_environment(table: TomlTable, image: FloatArray | None = None) -> LightEnvironment | LightPath:
    """Reads ``[environment]``: an environment map, a constant colour, or a map multiplied by a colour.

    Args:
        table: The table; one with keyframes becomes a path.
        image: Radiance of the map if it has been read already, shape (H, W, 3); None: it is read now.

    Raises:
        FormatError: A key is unknown, a value is invalid, or the image cannot be read.
    """
    keys = schema(LightEnvironment)
    keys = {"path": keys.pop("image"), **keys}
    given = table.take({**keys, "keyframes": KEYFRAMES})
    if image is None and "path" in given:
        image = _make(table, LightEnvironment, {"image": read_radiance(table.file("path"))}).image

    def still(entry: TomlTable) -> LightEnvironment:
        given = entry.take(keys)
        given.pop("path", None)
        light = _make(entry, LightEnvironment, given)
        return light if image is None else with_checked(light, image=image)

    if "keyframes" not in table.values:
        return still(table)
    changing = {key: value for key, value in keys.items() if key not in _CONSTANT}
    times, tables = read_keyframes(table, changing, lambda given, last: last | given)
    return _path(table, [still(entry) for entry in tables], times, None)


def _is_time(value: object) -> bool:
    return isinstance(value, str | datetime)


SUN_KEYS = schema(Daylight) | {
    "time": Kind("a date and time", _is_time),
    "north": DIRECTION,
    "hidden": FLAG,
}
"""Allowed keys of ``[sun]``."""


def read_sun(table: TomlTable, up: Vector) -> tuple[Daylight, tuple[Light | MovingLight, ...]]:
    """Reads ``[sun]``: sun and sky at a place and time.

    Args:
        table: The table.
        up: Unit vector that points up in the scene.

    Returns:
        The daylight, and its two lights, which change with time if its clock runs; no light if the table is hidden.

    Raises:
        FormatError: A key is unknown or missing, a value is invalid, or the time has no offset from UTC.
    """
    given = table.take(SUN_KEYS, required_keys(Daylight))
    is_hidden = given.pop("hidden", False)
    try:
        daylight = Daylight(**given)
        lights = daylight.lights(up)
    except SceneError as error:
        raise table.failed(error) from None
    if is_hidden:
        return daylight, ()
    return daylight, daylight.moving(up) if daylight.speed else lights


def _make(table: TomlTable, kind: type[_Light], values: Values) -> _Light:
    """Creates a light from checked values; a value that the light's class refuses is reported with file and line."""
    try:
        return kind(**values)
    except SceneError as error:
        raise table.failed(error) from None
