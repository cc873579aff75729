"""Where the scene is and how large: boxes around scene objects, measured once, and the length of a unit on pages."""

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


Array = npt.NDArray[np.float64]
Box = tuple[Array, Array]
"""Lowest and highest corner, shape (3,) each."""


def pose_of(entry: ls.io.SceneEntry, time: float) -> Array | None:
    """Where an entry stands at a time, seconds, a similarity, shape (4, 4); None: of lights."""
    if entry.world_from_file is None:
        return None
    placed, actor = np.asarray(entry.world_from_file, np.float64), entry.actor
    return placed if actor is None or actor.motion is None else actor.motion.at(time) @ placed


class BoxCache:
    """Boxes of entries."""

    def __init__(self) -> None:
        self._cached: dict[int, tuple[tuple[object, ...], Box]] = {}
        """By entry: what was measured, and its box."""

    def of(self, entry: ls.io.SceneEntry, time: float = 0.0) -> Box | None:
        """The box around the bulk of what an entry shows at a time, in its file's coordinates; None: of lights.

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
        """Forgets the boxes, and so the assets, of entries that a document does not have."""
        present = {entry.id for entry in document.entries}
        self._cached = {number: held for number, held in self._cached.items() if number in present}

    def size(self, entry: ls.io.SceneEntry, time: float = 0.0) -> Array | None:
        """Lengths of an entry's box along its own axes, as large as it stands in the scene, shape (3,)."""
        box, pose = self.of(entry, time), pose_of(entry, time)
        return None if box is None or pose is None else scale_of(pose) * (box[1] - box[0])


def scale_of(pose: Array) -> float:
    """The scale of a similarity, shape (4, 4)."""
    return float(np.cbrt(np.linalg.det(pose[:3, :3])))


def world_corners(box: Box, pose: Array) -> Array:
    """The corners of a box in a file's coordinates as they stand in the world, shape (8, 3).

    Bit ``a`` of a corner's number says whether it is at the highest value of axis ``a``.
    """
    corners = np.array([[box[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _bulk_box(instances: Sequence[ls.SplatInstance | ls.MeshInstance], file_from_world: Array) -> Box:
    """The box around the bulk of instances, in a file's coordinates."""

    def in_file(instance: Any) -> Any:
        return replace(instance, world_from_object=file_from_world @ instance.transform)

    splats = [in_file(i) for i in instances if isinstance(i, ls.SplatInstance)]
    low, high = ls.Scene(splats, [in_file(i) for i in instances if isinstance(i, ls.MeshInstance)]).bulk_bounds()
    return np.asarray(low, np.float64), np.asarray(high, np.float64)
