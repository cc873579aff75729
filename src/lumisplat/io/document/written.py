"""Objects of a scene as tables of a scene file: lights, materials and placements, by what the readers read."""

from __future__ import annotations

import math
from dataclasses import MISSING, Field, fields
from typing import Any

import numpy as np

from lumisplat.constants import SIMILARITY_TOLERANCE
from lumisplat.io.scene_toml.fields import DEGREES, key_of
from lumisplat.io.scene_toml.materials import MATERIAL_KINDS
from lumisplat.io.scene_toml.toml_table import Values
from lumisplat.io.scene_toml.toml_text import plain_value
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import Material

PLACED_IN_WORDS = ("rotation_degrees", "look_at", "front", "upright", "ground")
"""Keys that a placement by position, rotation and scale replaces."""
_ROUNDED = {"inner_angle": -1, "outer_angle": 1}
"""How angles of spots are rounded: the inner one stays below the outer one."""
_STEPS = 3
"""Neighbours of an angle that are tried, on each side."""


def light_table(light: Light) -> Values:
    """The entry of a light; of an environment the table, without its image."""
    table = {} if isinstance(light, LightEnvironment) else {"type": light.kind}
    return table | _values(light, without=("image",))


def material_table(material: Material) -> Values:
    """The table of a material, without its textures."""
    textures = tuple(field.name for field in fields(material) if field.name.endswith(("_texture", "_wraps")))
    return {"type": _name(MATERIAL_KINDS, type(material))} | _values(material, without=textures)


def placement_table(matrix: Doubles) -> Values:
    """The keys that place an entry by a similarity, shape (4, 4)."""
    scale = _rounded(np.cbrt(np.linalg.det(matrix[:3, :3])))
    quaternion = quaternions_from_matrices(matrix[None, :3, :3] / scale)[0]
    return {
        "position": [_rounded(x) for x in matrix[:3, 3]],
        "rotation_wxyz": [_rounded(x) for x in quaternion],
        "scale": scale,
    }


def _rounded(number: float) -> float:
    """Twelve digits: what people read should not end in noise."""
    return float(f"{number:.12g}")


def is_similarity(matrix: Doubles) -> bool:
    """Whether a transform, shape (4, 4), is a rotation, one scale and a translation: what an entry can say."""
    linear = matrix[:3, :3]
    gram = linear.T @ linear
    size = np.trace(gram) / 3.0
    return bool(np.linalg.det(linear) > 0.0 and np.abs(gram / size - np.eye(3)).max() < SIMILARITY_TOLERANCE)


def _values(item: Light | Material, without: tuple[str, ...]) -> Values:
    """The fields that differ from their defaults, by key."""
    table: Values = {}
    for field in fields(item):
        value = getattr(item, field.name)
        if field.name not in without and (field.default is MISSING or value != field.default):
            table[key_of(field)] = _written(field, value)
    return table


def _written(field: Field[Any], value: object) -> object:
    plain = plain_value(value)
    return _degrees(plain, _ROUNDED.get(field.name, 0)) if key_of(field).endswith(DEGREES) else plain


def _degrees(angle: float, rounded: int) -> float:
    """The degrees, at most 90, that the reader turns to an angle, or to one next to it.

    Args:
        angle: Radians.
        rounded: 0: to the nearest; 1: not to a smaller one; -1: not to a larger one.
    """
    near = [math.degrees(angle)]
    for end in (0.0, 90.0):
        step = math.degrees(angle)
        for _ in range(_STEPS):
            step = math.nextafter(step, end)
            near.append(step)
    back = {degrees: math.radians(degrees) for degrees in (*near, 0.0, 90.0) if 0.0 <= degrees <= 90.0}
    if rounded > 0:
        return min((degrees for degrees in back if back[degrees] >= angle), default=90.0)
    if rounded < 0:
        return max(degrees for degrees in back if back[degrees] <= angle)
    return min(back, key=lambda degrees: abs(back[degrees] - angle))


def _name(kinds: dict[str, Any], kind: type) -> str:
    return next(name for name, other in kinds.items() if other is kind)
