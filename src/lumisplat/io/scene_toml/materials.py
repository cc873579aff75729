"""Reads the materials of a scene file: named ones in ``[materials.NAME]``, or inline tables of entries.

[materials.varnish]
type = "pbr"                        # or "simple"; "pbr" is the default
roughness = 0.2
base_color_texture = "oak.png"      # relative to the scene file

[[materials.varnish.keyframes]]     # the values change with time; missing keys are inherited from the one before
time = 0.0

[[materials.varnish.keyframes]]
time = 2.0
roughness = 0.8

[[meshes]]
path = "table.obj"
material = "varnish"                # or { roughness = 0.2 }
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.io.images.texture import read_texture
from lumisplat.io.scene_toml.keyframes import KEYFRAMES, read_keyframes
from lumisplat.io.scene_toml.toml_table import COLOR, NUMBER, TEXT, TomlTable, Values, is_object, schema, suggestion
from lumisplat.math.color import decode_srgb
from lumisplat.scene.animation.lights import MaterialPath
from lumisplat.scene.materials import MESH_COLOR, Color, Material, MaterialPbr, MaterialSimple

_log = logging.getLogger("lumisplat")

MATERIAL_KINDS: dict[str, type[MaterialPbr] | type[MaterialSimple]] = {"pbr": MaterialPbr, "simple": MaterialSimple}
"""Material classes by their ``type`` in a scene file."""
EIGHT_BIT_ABOVE = 16.0
"""Emission whose largest channel is a whole number above this, up to 255, is asked about: it looks like an 8-bit
colour. Whole numbers up to 16 are usual strengths of lights."""
_SHARED = ("base_color_texture", "name")
"""Fields, beside the base colour, that `MaterialPbr` and `MaterialSimple` have in common.

A material table takes these fields even from a file's material of the other type."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialTable:
    """A material of a scene file: its type, and only the values that the file sets."""

    kind: type[MaterialPbr] | type[MaterialSimple]
    values: Values

    def apply_to(self, file_material: Material | None) -> Material:
        """Returns the material of a surface after this table has overridden the material of its file.

        Values that the table does not set are taken from ``file_material`` if it has the same type. If it has another
        type, only base colour, base colour texture and name are taken. If the table sets a base colour texture and the
        surface has the default grey, the base colour becomes white, so that the grey does not darken the texture.
        """
        if isinstance(file_material, self.kind):
            is_grey = isinstance(file_material, MaterialPbr) and file_material.mesh_color == MESH_COLOR
            white = {"base_color": (1.0, 1.0, 1.0)} if is_grey and "base_color_texture" in self.values else {}
            return replace(file_material, **(white | self.values))
        shared: Values = {}
        if file_material is not None:
            shared = {name: getattr(file_material, name) for name in _SHARED} | {"base_color": file_material.mesh_color}
        return self.kind(**(shared | self.values))


def read_materials(document: TomlTable) -> dict[str, MaterialTable]:
    """Reads the named materials of a scene file.

    Raises:
        FormatError: A material is not a table, or is invalid.
    """
    named = document.table("materials")
    return {name: _read_material(named.table(name), name) for name in named.values}


def read_material_paths(document: TomlTable) -> list[MaterialPath]:
    """Reads how the named materials of a scene file change with time: those with keyframes.

    Raises:
        FormatError: A keyframe has an unknown key or an invalid value, or times do not increase.
    """
    named = document.table("materials")
    tables = {name: named.table(name) for name in named.values}
    return [_read_path(table, name) for name, table in tables.items() if "keyframes" in table.values]


def _read_path(table: TomlTable, name: str) -> MaterialPath:
    material = _kind_of(table)
    changing = {key: kind for key, kind in schema(material).items() if kind in (NUMBER, COLOR)}
    times, tables = read_keyframes(table, changing, lambda given, last: last | given)
    frames = table.tables("keyframes")
    columns: dict[str, list[Any]] = {key: [] for key in changing if any(key in frame.values for frame in frames)}
    for entry in tables:
        for key, column in columns.items():
            if key not in entry.values:
                raise entry.error(f"lacks {key}, {changing[key].expected}, here or in the material above")
            try:
                column.append(getattr(material(**{key: entry.values[key]}), key))
            except SceneError as error:
                raise entry.failed(error) from None
    return MaterialPath(table.values.get("name", name), times, columns)


def _kind_of(table: TomlTable) -> type[MaterialPbr] | type[MaterialSimple]:
    """Returns the class of a material by its ``type``; raises a `FormatError` for an unknown type."""
    name = table.values.get("type", "pbr")
    kind = MATERIAL_KINDS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise table.wrong("type", " or ".join(MATERIAL_KINDS))
    return kind


def _read_material(table: TomlTable, name: str | None = None) -> MaterialTable:
    """Reads one material table.

    Args:
        table: The table.
        name: Name of the material if the table has no ``name``.
    """
    kind = _kind_of(table)
    if name is None and "keyframes" in table.values:
        raise table.error("keyframes change named materials: write it as [materials.NAME]", "keyframes")
    values = table.take({"type": TEXT, **schema(kind), "keyframes": KEYFRAMES})
    values.pop("type", None)
    values.pop("keyframes", None)
    if name is not None:
        values.setdefault("name", name)
    for key in values:
        if key.endswith("_texture"):
            values[key] = read_texture(table.file(key), table.textures)
    try:
        material = kind(**values)
    except SceneError as error:
        raise table.failed(error) from None
    for key in ("emissive", "ambient"):
        if key in values and (line := _eight_bit_remark(key, getattr(material, key))):
            _log.warning("%s", table.error(line, key))
    return MaterialTable(kind, values)


def _eight_bit_remark(key: str, color: Color) -> str | None:
    """Returns the question whether a factor was meant as 0..255, or None if it does not look so."""
    if not EIGHT_BIT_ABOVE < max(color) <= 255.0 or any(channel % 1.0 for channel in color):
        return None
    linear = ", ".join(f"{channel:.3g}" for channel in decode_srgb(np.array(color) / 255.0))
    given = ", ".join(f"{channel:g}" for channel in color)
    return f"{key} is [{given}], where 1 is white: if it was meant as 0..255, write [{linear}], which is linear"


def entry_material(entry: TomlTable, named: Mapping[str, MaterialTable]) -> MaterialTable | None:
    """Reads the ``material`` of an entry, a name or an inline table; None if the entry has none.

    Raises:
        FormatError: There is no material of this name, or the table is invalid.
    """
    given = entry.values.get("material")
    if given is None:
        return None
    if is_object(given):
        return _read_material(entry.table("material"))
    if given not in named:
        hint = suggestion(given, named) if named else f"there is no [materials.{given}]"
        raise entry.error(f"material is {given!r}, {hint}", "material")
    return named[given]
