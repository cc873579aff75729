"""Standing things on the ground."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.errors import SceneError
from lumisplat.math.transforms import transform_points
from lumisplat.scene.scene import MeshInstance, SplatInstance, bulk_extent
from lumisplat.scene.up import up_vector

_Placed = TypeVar("_Placed", SplatInstance, MeshInstance)


def stand_on_ground(instance: _Placed, height: float = 0.0, *, up: str | npt.ArrayLike) -> _Placed:
    """An instance moved along the vertical, so that its lowest point is at a height.

    The lowest point of a capture leaves out 2 % of its opacity, so that stray Gaussians below it do not lift it.

    Args:
        instance: A placed capture or mesh.
        height: Height of the ground along ``up``, scene units: where y is down, a floor at y = 1.2 has height -1.2.
        up: Up of the scene, an axis (``"y-down"``) or a direction: `Scene.up_direction`.

    Raises:
        SceneError: It is no instance, or an argument is out of range.
    """
    if not isinstance(cast(object, instance), SplatInstance | MeshInstance):
        raise SceneError(f"stand_on_ground takes a SplatInstance or a MeshInstance, got a {type(instance).__name__}")
    if not is_number(height) or not math.isfinite(height):
        raise SceneError(f"height is {height}, expected a finite number")
    move = np.eye(4)
    move[:3, 3] = (height - lowest(instance, up)) * np.array(up_vector(up))
    return replace(instance, world_from_object=move @ instance.transform)


def lowest(instance: SplatInstance | MeshInstance, up: str | npt.ArrayLike) -> float:
    """Height of the lowest point of an instance along ``up``, of a capture without its lowest 2 % of opacity."""
    upward = np.array(up_vector(up))
    if isinstance(instance, SplatInstance):
        return bulk_extent(instance.world_means @ upward, instance.gaussians.opacities)[0]
    mesh = instance.mesh
    return float((transform_points(instance.transform, mesh.positions[np.unique(mesh.indices)]) @ upward).min())
