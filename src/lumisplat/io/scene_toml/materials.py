"""Materials of a scene file: named ones in ``[materials.NAME]``, or written where they are used.

[materials.varnish]
type = "pbr"                        # or "simple"; pbr if it is left out
roughness = 0.2
base_color_texture = "oak.png"      # relative to the scene file

[[meshes]]
path = "table.obj"
material = "varnish"                # or { roughness = 0.2 }
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from lumisplat.errors import SceneError
from lumisplat.io.images.image import read_texture
from lumisplat.io.scene_toml.fields import schema
from lumisplat.io.scene_toml.toml_table import TEXT, TomlTable, suggestion
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple

_KINDS = {"pbr": MaterialPbr, "simple": MaterialSimple}
_SHARED = ("base_color", "base_color_texture", "name")
"""What a file says about a surface that any kind of material can keep."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialTable:
    """What a scene file says about a surface."""

    kind: type[MaterialPbr] | type[MaterialSimple]
    values: dict[str, Any]

    def applied(self, own: Material | None) -> Material:
        """The material of a surface: what is not said stays as in ``own``, where that is of the same kind.

        Of a material of the other kind, colour, texture and name stay.
        """
        if isinstance(own, self.kind):
            return replace(own, **self.values)
        kept = {} if own is None else {name: getattr(own, name) for name in _SHARED}
        return self.kind(**(kept | self.values))


def read_materials(document: TomlTable) -> dict[str, MaterialTable]:
    """The named materials of a scene file.

    Raises:
        FormatError: One is no table, or bad.
    """
    named = document.table("materials")
    return {name: read_material(named.table(name), name) for name in named.values}


def read_material(table: TomlTable, name: str = "") -> MaterialTable:
    """A material written as a table.

    Raises:
        FormatError: An unknown type or key, a bad value, or a texture that cannot be read.
    """
    type_name = table.values.get("type", "pbr")
    kind = _KINDS.get(type_name) if isinstance(type_name, str) else None
    if kind is None:
        raise table.wrong("type", " or ".join(_KINDS))
    values = table.take({"type": TEXT, **schema(kind)})
    values.pop("type", None)
    if name:
        values.setdefault("name", name)
    for key in values:
        if key.endswith("_texture"):
            values[key] = read_texture(table.file(key))
    try:
        kind(**values)
    except SceneError as error:
        raise table.failed(error) from None
    return MaterialTable(kind, values)


def material_of(entry: TomlTable, named: Mapping[str, MaterialTable]) -> MaterialTable | None:
    """What the ``material`` of an entry says: a name, or a table of its own; None where it says nothing.

    Raises:
        FormatError: There is no such name, or the table is bad.
    """
    given = entry.values.get("material")
    if given is None:
        return None
    if isinstance(given, dict):
        return read_material(entry.table("material"))
    if given not in named:
        meant = suggestion(given, named) if named else f"there is no [materials.{given}]"
        raise entry.error(f"material is {given!r}, {meant}", "material")
    return named[given]
