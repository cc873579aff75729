"""Lights that paths show as bodies: rays that meet one show it, and not only what Gaussians reflect."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from lumisplat.math.arrays import Flags, FloatArray
from lumisplat.scene.lights import AreaLight, Light


def meets_light(lights: Iterable[Light], origins: FloatArray, directions: FloatArray) -> Flags:
    """Returns which rays reach a light that is visible, whatever hides it, shape (N,).

    Args:
        lights: Of a scene.
        origins: World space, shape (N, 3).
        directions: Unit, shape (N, 3).
    """
    starts, along = origins.astype(np.float64), directions.astype(np.float64)
    meets = np.zeros(len(origins), np.bool_)
    for light in lights:
        if isinstance(light, AreaLight) and light.enabled and light.visible:
            meets |= np.isfinite(light.distances(starts, along))
    return meets
