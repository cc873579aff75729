"""Lights that paths show as bodies: rays that meet one show it, and not only what Gaussians reflect."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.scene.lights import Light, LightRect, LightSphere


def meets_light(lights: Iterable[Light], origins: FloatArray, directions: FloatArray) -> Flags:
    """Which rays meet a light that is visible, whatever hides it, shape (N,).

    Args:
        lights: Of a scene.
        origins: World space, shape (N, 3).
        directions: Unit, shape (N, 3).
    """
    meets = np.zeros(len(origins), np.bool_)
    starts, ways = origins.astype(np.float64), directions.astype(np.float64)
    for light in lights:
        if not isinstance(light, LightRect | LightSphere) or not (light.enabled and light.visible):
            continue
        away = np.array(light.position) - starts
        meets |= _meets_sphere(light, away, ways) if isinstance(light, LightSphere) else _meets_rect(light, away, ways)
    return meets


def _meets_sphere(light: LightSphere, away: Doubles, ways: Doubles) -> Flags:
    """From outside; ``away`` is from where rays begin to the light's middle."""
    along = (away * ways).sum(axis=1)
    beside = np.linalg.norm(away - along[:, None] * ways, axis=1)
    return (along > 0.0) & (beside <= light.radius) & (np.linalg.norm(away, axis=1) > light.radius)


def _meets_rect(light: LightRect, away: Doubles, ways: Doubles) -> Flags:
    """The side that shines."""
    edges = np.array([light.edge_u, light.edge_v])
    across = np.cross(*edges)
    cosines = ways @ across
    t = np.divide(away @ across, cosines, out=np.full(len(ways), -1.0), where=cosines < 0.0)
    place = t[:, None] * ways - away
    shares = np.stack([np.cross(place, edges[1]) @ across, np.cross(edges[0], place) @ across]) / (across @ across)
    return np.asarray((t > 0.0) & (np.abs(shares) <= 0.5).all(axis=0))
