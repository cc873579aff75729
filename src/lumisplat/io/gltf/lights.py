"""Reads and writes glTF lights (KHR_lights_punctual), in the same units as Lumisplat: candela and lux.

A light lies at the origin of its node and shines along -z.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable
from typing import Any

import numpy as np

from lumisplat.config.checks import is_number
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.gltf.container import GltfDocument, GltfFile
from lumisplat.io.gltf.nodes import Matrix, light_extras, light_settings, lumisplat_extras, node_item, with_extras
from lumisplat.scene.lights import LIGHT_KINDS, AimedLight, Light, LightPoint, LightSphere, LightSpot, PlacedLight

_log = logging.getLogger("lumisplat")

EXTENSION = "KHR_lights_punctual"

_CONE_EDGE = 1e-3
"""Angle in radians by which the inner cone is made narrower than the outer one if a spot states equal angles."""

_PUNCTUAL = {kind: light for kind, light in LIGHT_KINDS.items() if light.unit in ("cd", "lux")}
"""Light classes that glTF can store, by their type name: those with an intensity in candela or lux."""


def read_lights(file: GltfFile, nodes: Iterable[int], world_from_node: list[Matrix]) -> list[Light]:
    """Reads the lights of ``nodes`` into world space, in order, each named after its node, else after the light.

    The scale of a node moves a light but does not change its intensity or range. Lights of nodes with zero scale are
    skipped.

    Raises:
        FormatError: An index is invalid, a type is unknown, or a value is out of range; the message names the light.
    """
    definitions = (file.model.extensions or {}).get(EXTENSION, {}).get("lights", [])
    lights: list[Light] = []
    for index in nodes:
        node = file.model.nodes[index]
        reference = (node.extensions or {}).get(EXTENSION)
        if reference is None or not world_from_node[index][:3, :3].any():
            continue
        which = reference.get("light")
        if not isinstance(which, int) or not 0 <= which < len(definitions):
            raise FormatError(file.path, f"nodes[{index}] refers to lights[{which}], but there are {len(definitions)}")
        label = f"lights[{which}]" + (f" {definitions[which]['name']!r}" if definitions[which].get("name") else "")
        definition = _within_limits(file, definitions[which], label)
        try:
            lights.append(_light(definition, world_from_node[index], node.name or definition.get("name") or ""))
        except SceneError as error:
            raise FormatError(file.path, f"{label}: {error}") from None
    return lights


def _within_limits(file: GltfFile, definition: dict[str, Any], label: str) -> dict[str, Any]:
    """Returns a light definition with two invalid values of other programs repaired; each repair is logged.

    A range of 0, as three.js writes it, is removed and so means no limit. Inner and outer cone angles that are equal
    get a difference of `_CONE_EDGE`.
    """
    changes: list[str] = []
    definition = dict(definition)
    reach: object = definition.get("range")
    if is_number(reach) and reach <= 0.0:
        del definition["range"]
        changes.append(f"range {reach:g} is read as infinite")
    cone: dict[str, Any] = definition.get("spot", {}) if definition.get("type") == "spot" else {}
    inner, outer = cone.get("innerConeAngle", 0.0), cone.get("outerConeAngle", 0.25 * math.pi)
    at_border = is_number(inner) and is_number(outer) and outer - _CONE_EDGE < inner < outer + _CONE_EDGE
    if at_border and 0.0 <= outer < 0.5 * math.pi + _CONE_EDGE:
        wide = min(max(outer, 2.0 * _CONE_EDGE), 0.5 * math.pi)
        definition["spot"] = cone | {"innerConeAngle": wide - _CONE_EDGE, "outerConeAngle": wide}
        changes.append(f"its cone from {inner:g} to {outer:g} is read as from {wide - _CONE_EDGE:g} to {wide:g}")
    if changes:
        _log.warning("%s: %s: %s", os.fspath(file.path), label, "; ".join(changes))
    return definition


def _light(definition: dict[str, Any], world_from_light: Matrix, name: str) -> Light:
    """Builds a light from its definition and its node's world transform."""
    kind = definition.get("type")
    light = _PUNCTUAL.get(kind) if isinstance(kind, str) else None
    if light is None:
        raise SceneError(f"type is {kind!r}, expected {', '.join([*_PUNCTUAL][:-1])} or {[*_PUNCTUAL][-1]}")
    values: dict[str, Any] = {key: definition[key] for key in ("color", "intensity") if key in definition}
    values |= {"name": name, **light_settings(lumisplat_extras(definition), light)}
    if issubclass(light, AimedLight):
        values["direction"] = -world_from_light[:3, 2]
    if issubclass(light, PlacedLight):
        values |= {"position": world_from_light[:3, 3], "range": definition.get("range", math.inf)}
    if light is LightSpot:
        cone = definition.get("spot", {})
        values |= {
            f"{side}_angle": cone[f"{side}ConeAngle"] for side in ("inner", "outer") if f"{side}ConeAngle" in cone
        }
    return light(**values)


def add_light(document: GltfDocument, light: Light, file_from_world: Matrix) -> int | None:
    """Appends a light and its node, and returns the node's index; None if glTF cannot store the light.

    A sphere light becomes a point light with the intensity that the sphere has from outside, ``intensity * pi *
    radius^2`` candela.
    """
    if isinstance(light, LightSphere):
        candela = light.intensity * math.pi * light.radius**2
        light = LightPoint(
            light.position, light.color, candela, radius=light.radius, casts_shadow=light.casts_shadow, name=light.name
        )
    if light.kind not in _PUNCTUAL:
        return None
    strongest = max(light.color)
    item: dict[str, Any] = {"name": light.name} if light.name else {}
    item["color"] = [channel / strongest for channel in light.color] if strongest > 1.0 else list(light.color)
    item |= {"intensity": light.intensity * max(strongest, 1.0), "type": light.kind}
    matrix = np.eye(4)
    if isinstance(light, PlacedLight):
        matrix[:3, 3] = light.position
    if isinstance(light, AimedLight):
        matrix[:3, :3] = _shining_along(light.direction)
    if isinstance(light, LightPoint | LightSpot) and math.isfinite(light.range):
        item["range"] = light.range
    if isinstance(light, LightSpot):
        outer = min(light.outer_angle, math.pi / 2.0)
        item["spot"] = {"innerConeAngle": light.inner_angle, "outerConeAngle": outer}
    number = document.add_light(with_extras(item, light_extras(light)))
    node = node_item(file_from_world @ matrix, light.name) | {"extensions": document.use(EXTENSION, light=number)}
    return document.add("nodes", node)


def _shining_along(direction: tuple[float, float, float]) -> Matrix:
    """Returns a rotation, shape (3, 3), whose -z axis is a unit direction."""
    back = -np.array(direction)
    aside = np.cross(np.eye(3)[np.abs(back).argmin()], back)
    aside /= np.linalg.norm(aside)
    return np.stack([aside, np.cross(back, aside), back], axis=1)
