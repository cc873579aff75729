"""The nodes of a rig and their transforms to world space, at rest and at a time of a clip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.animation.clips import Channel, Clip


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """N nodes with their transforms at rest. A node scales a point first, then rotates, then translates it."""

    parents: tuple[int | None, ...]
    """Index of each node's parent; None for a root."""
    order: tuple[int, ...]
    """All nodes, parents first."""
    translations: Doubles
    """Shape (N, 3)."""
    rotations_wxyz: Doubles
    """Unit quaternions, shape (N, 4)."""
    scales: Doubles
    """Shape (N, 3)."""
    matrices: Mapping[int, Doubles]
    """``parent_from_node`` of the nodes that have a matrix instead of the three parts; clips do not move them."""

    def world_from_node(self, clip: Clip | None = None, time: float = 0.0) -> Doubles:
        """The transforms of all nodes to world space, shape (N, 4, 4).

        Args:
            clip: The animation; None: the nodes are at rest.
            time: Time of the clip, seconds.
        """
        columns = {
            Channel.TRANSLATION: self.translations.copy(),
            Channel.ROTATION: self.rotations_wxyz.copy(),
            Channel.SCALE: self.scales.copy(),
        }
        for track in clip.tracks if clip else ():
            if track.channel is not Channel.WEIGHTS:
                columns[track.channel][track.node] = track.at(time)
        local = np.tile(np.eye(4), (len(self.parents), 1, 1))
        rotations = matrices_from_quaternions(columns[Channel.ROTATION])
        local[:, :3, :3] = rotations * columns[Channel.SCALE][:, None, :]
        local[:, :3, 3] = columns[Channel.TRANSLATION]
        for node, matrix in self.matrices.items():
            local[node] = matrix
        world = local.copy()
        for node in self.order:
            parent = self.parents[node]
            if parent is not None:
                world[node] = world[parent] @ local[node]
        return world
