"""What our glTF files say in ``extras``, which other programs ignore: settings that glTF has no place for.

Each is an object under the key ``lumisplat``, with fields of the class that it is of.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import MISSING, fields
from typing import Any, cast

from lumisplat.errors import SceneError
from lumisplat.io.files.source import with_present_keys
from lumisplat.scene.lights import Light
from lumisplat.scene.materials import Material, MaterialPbr, MaterialSimple
from lumisplat.scene.scene import SplatInstance

OURS = "lumisplat"
"""Their key."""

_MATERIALS: dict[str, type[MaterialPbr] | type[MaterialSimple]] = {"pbr": MaterialPbr, "simple": MaterialSimple}
_NOT_OF_CAPTURES = ("_texture", "_wraps", "wrap_u", "wrap_v", "alpha_mode")
"""Ends of the fields of materials that captures do not have."""
_LIGHTS = ("radius", "angle", "casts_shadow", "shadow_distance")
_INSTANCES = ("sh_degree", "shadow_catcher")
CAMERAS = ("width", "height", "exposure", "aperture", "focus_distance")


def own_extras(item: Any) -> dict[str, Any] | None:
    """What our files say of an item besides; None: the file is of somebody else.

    Args:
        item: An object of pygltflib, or a part of the JSON.
    """
    extras: object = cast("dict[str, object]", item).get("extras") if isinstance(item, dict) else item.extras
    own = cast("dict[str, object]", extras).get(OURS) if isinstance(extras, dict) else None
    return cast("dict[str, Any]", own) if isinstance(own, dict) else None


def with_extras(item: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """A part of the JSON, with what only we read."""
    return item | ({"extras": {OURS: own}} if own else {})


def light_extras(light: Light) -> dict[str, Any]:
    """Of a light: its size for soft shadows, and which shadows it casts."""
    return _changed(light, _LIGHTS)


def light_settings(own: dict[str, Any] | None, kind: type[Any]) -> dict[str, Any]:
    """The inverse: what a light of a class is made with besides."""
    known = {field.name for field in fields(kind)}
    return {name: value for name, value in _known(own, _LIGHTS).items() if name in known}


def instance_extras(splat: SplatInstance) -> dict[str, Any]:
    """Of a capture that is placed: how it reflects light, and what of it is shown."""
    own = _changed(splat, _INSTANCES)
    material = splat.material
    if material is not None:
        kind = next(name for name, cls in _MATERIALS.items() if isinstance(material, cls))
        own["material"] = {"type": kind, **_changed(material, _material_fields(type(material)))}
    return own


def instance_settings(own: dict[str, Any] | None) -> dict[str, Any]:
    """The inverse: what a `SplatInstance` is made with besides.

    Raises:
        SceneError: A value is out of range, or the material of no known type.
    """
    settings = _known(own, _INSTANCES)
    given = (own or {}).get("material")
    if given is not None:
        settings["material"] = _material(given)
    return settings


def _material(given: object) -> Material:
    table = cast("dict[str, Any]", given) if isinstance(given, dict) else {}
    kind = _MATERIALS.get(str(table.get("type")))
    if kind is None:
        raise SceneError(f"its material is of type {str(table.get('type'))[:60]}, expected pbr or simple")
    return kind(**_known(table, _material_fields(kind)))


def _material_fields(kind: type[Material]) -> list[str]:
    return [field.name for field in fields(kind) if not field.name.endswith(_NOT_OF_CAPTURES)]


def _known(own: dict[str, Any] | None, names: Iterable[str]) -> dict[str, Any]:
    given = with_present_keys(own or {})
    return {name: given[name] for name in names if name in given}


def _changed(item: Any, names: Iterable[str]) -> dict[str, Any]:
    """The named fields that an item has and that differ from their defaults, as JSON takes them."""
    wanted = set(names)
    held = {field: getattr(item, field.name) for field in fields(item) if field.name in wanted}
    return {
        field.name: list(cast("tuple[Any, ...]", value)) if isinstance(value, tuple) else value
        for field, value in held.items()
        if field.default is MISSING or value != field.default
    }
