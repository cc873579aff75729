"""Boxes around what entries show, in the coordinates of their files; each is measured once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

import lumisplat as ls

Vector = npt.NDArray[np.float64]
Box = tuple[Vector, Vector]
"""Lowest and highest corner, shape (3,) each."""


def pose_of(entry: ls.SceneEntry, time: float) -> Vector | None:
    """Where an entry stands at a time, seconds, a similarity, shape (4, 4); None: of lights."""
    if entry.world_from_file is None:
        return None
    placed, actor = np.asarray(entry.world_from_file, np.float64), entry.actor
    return placed if actor is None or actor.motion is None else actor.motion.at(time) @ placed


class Boxes:
    """Boxes of entries."""

    def __init__(self) -> None:
        self._held: dict[int, tuple[tuple[object, ...], Box]] = {}
        """By entry: what was measured, and its box."""

    def of(self, entry: ls.SceneEntry, time: float = 0.0) -> Box | None:
        """The box around the bulk of what an entry shows at a time, in its file's coordinates; None: of lights.

        Raises:
            FormatError: A frame of an actor cannot be read.
        """
        pose, instances = pose_of(entry, time), entry.at(time)
        if pose is None or not instances:
            return None
        assets = tuple(i.gaussians if isinstance(i, ls.SplatInstance) else i.mesh for i in instances)
        held = self._held.get(entry.id)
        if held is None or len(held[0]) != len(assets) or any(a is not b for a, b in zip(held[0], assets, strict=True)):
            held = assets, _measured(instances, np.asarray(np.linalg.inv(pose), np.float64))
            self._held[entry.id] = held
        return held[1]

    def keep(self, document: ls.SceneDocument) -> None:
        """Forgets the boxes, and so the assets, of entries that a document does not have."""
        present = {entry.id for entry in document.entries}
        self._held = {number: held for number, held in self._held.items() if number in present}

    def size(self, entry: ls.SceneEntry, time: float = 0.0) -> Vector | None:
        """Lengths of an entry's box along its own axes, as large as it stands in the scene, shape (3,)."""
        box, pose = self.of(entry, time), pose_of(entry, time)
        return None if box is None or pose is None else scale_of(pose) * (box[1] - box[0])


def scale_of(pose: Vector) -> float:
    """The scale of a similarity, shape (4, 4)."""
    return float(np.cbrt(np.linalg.det(pose[:3, :3])))


def world_corners(box: Box, pose: Vector) -> Vector:
    """The corners of a box in a file's coordinates as they stand in the world, shape (8, 3).

    Bit ``a`` of a corner's number says whether it is at the highest value of axis ``a``.
    """
    corners = np.array([[box[i >> axis & 1][axis] for axis in range(3)] for i in range(8)])
    return corners @ pose[:3, :3].T + pose[:3, 3]


def _measured(instances: Sequence[ls.SplatInstance | ls.MeshInstance], file_from_world: Vector) -> Box:
    """The box around the bulk of instances, in a file's coordinates."""

    def in_file(instance: Any) -> Any:
        return replace(instance, world_from_object=file_from_world @ instance.transform)

    splats = [in_file(i) for i in instances if isinstance(i, ls.SplatInstance)]
    low, high = ls.Scene(splats, [in_file(i) for i in instances if isinstance(i, ls.MeshInstance)]).bulk_bounds()
    return np.asarray(low, np.float64), np.asarray(high, np.float64)
