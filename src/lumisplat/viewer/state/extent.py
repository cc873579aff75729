"""Where the scene is and how large, and how long a unit of it is on pages."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

import lumisplat as ls

Vector = tuple[float, float, float]

PAGE_SIZES = (0.3, 30.0)
"""Diagonals of scenes, in units of a page, that pages take as they are: their depth ends at 167 units."""


@dataclass(frozen=True)
class Extent:
    """The bulk of a scene, measured when it is opened; its ground, when up changes, too."""

    center: Vector = (0.0, 0.0, 0.0)
    size: float = 1.0
    """Diagonal of the bulk, scene units, above 0."""
    height_below: float = 0.5
    """How far below the centre the bulk ends, scene units."""

    @classmethod
    def of(cls, scene: ls.Scene) -> Extent:
        """That of a scene; of an empty one, a unit at the origin."""
        if not (scene.splats or scene.meshes):
            return cls()
        low, high = scene.bulk_bounds()
        size = float(np.linalg.norm(high - low))
        x, y, z = (float(value) for value in 0.5 * (low + high))
        return cls((x, y, z), size if 1e-6 < size < math.inf else 1.0).with_ground(scene)

    def with_ground(self, scene: ls.Scene) -> Extent:
        """With the ground of a scene, at right angles to its up."""
        instances, up = (*scene.splats, *scene.meshes), np.array(scene.up_direction)
        if not instances:
            return self
        ground = min(lowest_height(instance, scene.up_direction) for instance in instances)
        return replace(self, height_below=float(np.array(self.center) @ up) - ground)

    @property
    def page_from_scene(self) -> float:
        """Units of a page in one of the scene: a power of ten, 1 for most scenes."""
        low, high = PAGE_SIZES
        return 1.0 if low <= self.size <= high else 10.0 ** -round(math.log10(self.size / 3.0))

    @property
    def dome_radius(self) -> float:
        """Of the dome on which suns are held, scene units: small enough to be in view when all of the scene is."""
        return 0.35 * self.size


def lowest_height(instance: ls.SplatInstance | ls.MeshInstance, up: Vector) -> float:
    """Height of the lowest point of an instance along up, of a capture without stray Gaussians below it."""
    stood: Any = ls.stand_on_ground(cast(Any, instance), 0.0, up=up)
    return float(np.array(up) @ (instance.transform[:3, 3] - stood.transform[:3, 3]))
