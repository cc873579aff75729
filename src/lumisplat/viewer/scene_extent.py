"""Measures the scene and its entries: bounding boxes without stray Gaussians, ground height, and page units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

import lumisplat as ls

Vector = tuple[float, float, float]

PAGE_SIZES = (0.3, 30.0)
"""Smallest and largest scene diagonal, scene units, that pages show without rescaling; other scenes are scaled by a
power of ten, because the depth range of a page ends at 167 units."""


@dataclass(frozen=True)
class Extent:
    """Centre, size and ground height of a scene when it was opened; stray Gaussians do not count.

    Only the ground height is measured again when the up direction changes.
    """

    center: Vector = (0.0, 0.0, 0.0)
    size: float = 1.0
    """Diagonal of the scene's bounding box without stray Gaussians, scene units, > 0."""
    height_below: float = 0.5
    """Distance from the centre of the bounding box down to the ground, scene units."""

    @classmethod
    def of(cls, scene: ls.Scene) -> Extent:
        """Measures a scene's bounding box and ground; an empty scene has its centre at the origin and size 1."""
        if not (scene.splats or scene.meshes):
            return cls()
        low, high = scene.bulk_bounds()
        size = float(np.linalg.norm(high - low))
        x, y, z = (float(value) for value in 0.5 * (low + high))
        return cls((x, y, z), size if 1e-6 < size < math.inf else 1.0).with_ground(scene)

    def with_ground(self, scene: ls.Scene) -> Extent:
        """Returns the extent with ``height_below`` measured to the lowest point of a scene along its up direction."""
        instances, up = (*scene.splats, *scene.meshes), np.array(scene.up_direction)
        if not instances:
            return self
        ground = min(lowest_height(instance, scene.up_direction) for instance in instances)
        return replace(self, height_below=float(np.array(self.center) @ up) - ground)

    @property
    def page_from_scene(self) -> float:
        """Factor from scene units to units of the browser page, a power of ten; 1 for scenes within `PAGE_SIZES`."""
        low, high = PAGE_SIZES
        return 1.0 if low <= self.size <= high else 10.0 ** -round(math.log10(self.size / 3.0))

    @property
    def dome_radius(self) -> float:
        """Radius of the dome on which the gizmos of suns are dragged, 0.35 times the scene diagonal, scene units."""
        return 0.35 * self.size


def lowest_height(instance: ls.SplatInstance | ls.MeshInstance, up: Vector) -> float:
    """Returns the height of an instance's lowest point, its dot product with ``up``; ignores stray Gaussians below."""
    stood: Any = ls.stand_on_ground(cast(Any, instance), 0.0, up=up)
    return float(np.array(up) @ (instance.transform[:3, 3] - stood.transform[:3, 3]))


Array = npt.NDArray[np.float64]
Box = tuple[Array, Array]
"""Lowest and highest corner of an axis-aligned box, shape (3,) each."""


def pose_of(entry: ls.io.SceneEntry, time: float) -> Array | None:
    """Returns the 4 x 4 similarity from an entry's file to the world at a time in seconds; None for lights."""
    if entry.world_from_file is None:
        return None
    placed, actor = np.asarray(entry.world_from_file, np.float64), entry.actor
    return placed if actor is None or actor.motion is None else actor.motion.at(time) @ placed


class BoxCache:
    """Computes bounding boxes of scene entries, and measures an entry again only if its assets have changed."""

    def __init__(self) -> None:
        self._cached: dict[int, tuple[tuple[object, ...], Box]] = {}
        """Bounding box by entry id, with the captures or meshes that were measured."""

    def of(self, entry: ls.io.SceneEntry, time: float = 0.0) -> Box | None:
        """Returns an entry's bounding box at a time in seconds, in file coordinates and without stray Gaussians.

        Returns None for lights and entries without instances.

        Raises:
            FormatError: A frame of an actor cannot be read.
        """
        pose, instances = pose_of(entry, time), entry.at(time)
        if pose is None or not instances:
            return None
        assets = tuple(i.gaussians if isinstance(i, ls.SplatInstance) else i.mesh for i in instances)
        held = self._cached.get(entry.id)
        if held is None or len(held[0]) != len(assets) or any(a is not b for a, b in zip(held[0], assets, strict=True)):
            held = assets, _bulk_box(instances, np.asarray(np.linalg.inv(pose), np.float64))
            self._cached[entry.id] = held
        return held[1]

    def prune(self, document: ls.io.SceneDocument) -> None:
        """Forgets the boxes of entries that a document no longer contains, which frees their captures and meshes."""
        present = {entry.id for entry in document.entries}
        self._cached = {number: held for number, held in self._cached.items() if number in present}

    def size(self, entry: ls.io.SceneEntry, time: float = 0.0) -> Array | None:
        """Returns side lengths of an entry's bounding box along its own axes, scene units, (3,); None for lights."""
        box, pose = self.of(entry, time), pose_of(entry, time)
        return None if box is None or pose is None else scale_of(pose) * (box[1] - box[0])


def scale_of(pose: Array) -> float:
    """Returns the uniform scale factor of a 4 x 4 similarity."""
    return float(np.cbrt(np.linalg.det(pose[:3, :3])))


def world_corners(box: Box, pose: Array) -> Array:
    """Returns the eight corners of a box in file coordinates, transformed to world space, shape (8, 3).

    Bit ``a`` of a corner's index is set if the corner is at the upper end of axis ``a``.

    Args:
        box: Lowest and highest corner, file coordinates.
        pose: Similarity from file to world, shape (4, 4).
    """
    corners = np.array([[box[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _bulk_box(instances: Sequence[ls.SplatInstance | ls.MeshInstance], file_from_world: Array) -> Box:
    """Returns the box around an entry's instances in file coordinates, without stray Gaussians (2 % at each end)."""

    def in_file(instance: Any) -> Any:
        return replace(instance, world_from_object=file_from_world @ instance.transform)

    splats = [in_file(i) for i in instances if isinstance(i, ls.SplatInstance)]
    low, high = ls.Scene(splats, [in_file(i) for i in instances if isinstance(i, ls.MeshInstance)]).bulk_bounds()
    return np.asarray(low, np.float64), np.asarray(high, np.float64)
