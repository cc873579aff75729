"""Irradiance of a light at points, without shadows: the formulas of device/light/light.py in NumPy."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from lumisplat.constants import LIGHT_DISTANCE_MIN
from lumisplat.math.arrays import Doubles
from lumisplat.scene.lights import (
    Light,
    LightDirectional,
    LightEnvironment,
    LightPoint,
    LightRect,
    LightSphere,
    LightSpot,
)


def facing_irradiance(light: Light, points: npt.NDArray[np.floating]) -> Doubles:
    """Irradiance of surfaces that face a light, all of which shines from its centre as for hard shadows.

    Args:
        light: Any light but an environment.
        points: World space, shape (N, 3).

    Returns:
        Linear Rec.709, shape (N, 3).
    """
    assert not isinstance(light, LightEnvironment)
    power = light.intensity * np.array(light.color)
    if isinstance(light, LightDirectional):
        return np.broadcast_to(power, (len(points), 3)).copy()
    offset = np.asarray(points, dtype=np.float64) - np.array(light.position)
    distance2 = np.maximum(np.einsum("ij,ij->i", offset, offset), LIGHT_DISTANCE_MIN**2)
    return (_candela_share(light, offset, distance2) / distance2)[:, None] * power


def _candela_share(light: Light, offset: Doubles, distance2: Doubles) -> Doubles:
    """Candela towards each point at an intensity of 1, shape (N,)."""
    if isinstance(light, LightSphere):
        return np.full_like(distance2, math.pi * light.radius**2)
    if isinstance(light, LightRect):
        normal = np.cross(light.edge_u, light.edge_v)
        return np.maximum(offset @ normal, 0.0) / np.sqrt(distance2)
    assert isinstance(light, LightPoint | LightSpot)
    share = np.clip(1.0 - (distance2 / light.range**2) ** 2, 0.0, 1.0)
    if isinstance(light, LightSpot):
        inner, outer = math.cos(light.inner_angle), math.cos(light.outer_angle)
        cosine = offset @ np.array(light.direction) / np.sqrt(distance2)
        share *= np.clip((cosine - outer) / max(inner - outer, 1e-30), 0.0, 1.0) ** 2
    return share
