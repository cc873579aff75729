"""Lights as those of KHR_lights_punctual, whose units are ours: candela and lux."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lumisplat.io.gltf.extras import light_extras, with_extras
from lumisplat.io.gltf.lights import EXTENSION
from lumisplat.io.gltf.nodes import Matrix
from lumisplat.io.gltf.writing.document import GltfDocument
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)


def can_hold_light(light: Light) -> bool:
    """Whether glTF has such a light; one that is off it has not."""
    return light.enabled and not isinstance(light, LightRect | LightEnvironment)


def add_light(document: GltfDocument, light: Light, file_from_world: Matrix) -> int | None:
    """Appends a light and its node; returns the node's index, None if glTF has no such light.

    A sphere becomes the point light that shines as it does from outside, of ``intensity * pi * radius^2`` candela.
    """
    if isinstance(light, LightSphere):
        candela = light.intensity * math.pi * light.radius**2
        light = LightPoint(
            light.position, light.color, candela, radius=light.radius, casts_shadow=light.casts_shadow, name=light.name
        )
    if isinstance(light, LightRect | LightEnvironment):
        return None
    strongest = max(light.color)
    item: dict[str, Any] = {"name": light.name} if light.name else {}
    item["color"] = [channel / strongest for channel in light.color] if strongest > 1.0 else list(light.color)
    item["intensity"] = light.intensity * max(strongest, 1.0)
    matrix = np.eye(4)
    if isinstance(light, LightDirectional):
        item["type"] = "directional"
        matrix[:3, :3] = _shining_along(light.direction)
    else:
        item["type"] = "point"
        matrix[:3, 3] = light.position
        if math.isfinite(light.range):
            item["range"] = light.range
    if isinstance(light, LightSpot):
        outer = min(light.outer_angle, math.pi / 2.0)
        item |= {"type": "spot", "spot": {"innerConeAngle": light.inner_angle, "outerConeAngle": outer}}
        matrix[:3, :3] = _shining_along(light.direction)
    number = document.add_light(with_extras(item, light_extras(light)))
    node = node_item(file_from_world @ matrix, light.name) | {"extensions": document.use(EXTENSION, light=number)}
    return document.add("nodes", node)


def node_item(matrix: Matrix, name: str) -> dict[str, Any]:
    """A node with a transform, shape (4, 4), and a name, if it has any."""
    item: dict[str, Any] = {"name": name} if name else {}
    if not np.array_equal(matrix, np.eye(4)):
        item["matrix"] = (matrix.T + 0.0).reshape(-1).tolist()  # by columns; without negative zeros
    return item


def _shining_along(direction: tuple[float, float, float]) -> Matrix:
    """A rotation, shape (3, 3), whose -z is a unit direction."""
    back = -np.array(direction)
    aside = np.cross(np.eye(3)[np.abs(back).argmin()], back)
    aside /= np.linalg.norm(aside)
    return np.stack([aside, np.cross(back, aside), back], axis=1)
