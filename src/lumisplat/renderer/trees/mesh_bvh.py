"""BVHs of the scene's meshes: one over the triangles of each mesh, and one over the mesh instances."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.constants import NODE_WIDTH, RAY_START_BACK, REBUILD_COST
from lumisplat.device.structs.bvh import MeshBvh, TriangleBvh, TriangleLeaf
from lumisplat.math.arrays import Doubles
from lumisplat.renderer.trees.box_tree import HostBoxTree
from lumisplat.runtime.buffers import bytes_of
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype, upload_structs
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene

TRIANGLE_BOX_MARGIN = 2.0**-19
"""Margin around triangle boxes as a fraction of the mesh's size: 32 roundings of a coordinate. Without the margin, 2 %
of the rays aimed at the edges of a cube from inside leave the cube."""

INSTANCE_BOX_MARGIN = 1e-3
"""Margin around the boxes of mesh instances as a fraction of their diagonal. Distant rays start at the box for
accuracy; the rounding error of that start, from a thousand diagonals away, is well below the margin."""


class TriangleTrees(HostBoxTree):
    """BVHs over the triangles of several meshes, built together, each in its mesh's object space.

    Args:
        launcher: Runs the kernels.
        meshes: The meshes; the index of a mesh is the index of its BVH's root node.
    """

    def __init__(self, launcher: Launcher, meshes: list[Mesh]) -> None:
        self.root_of = {id(mesh): number for number, mesh in enumerate(meshes)}
        self._meshes = meshes  # keeps the meshes alive, so that no other mesh gets one of their ids
        counts = np.array([mesh.face_count for mesh in meshes])
        boxes = [list(itertools.product(*zip(*mesh.bounds(), strict=True))) for mesh in meshes]
        self.corners: Doubles = np.array(boxes, np.float64)
        """Eight corners of the bounding box of each of M meshes, object space, shape (M, 8, 3)."""
        margins = TRIANGLE_BOX_MARGIN * np.linalg.norm(self.corners[:, -1] - self.corners[:, 0], axis=1)
        around = np.repeat(margins, counts)[:, None]
        faces: Doubles = np.concatenate([mesh.positions[mesh.indices].astype(np.float64) for mesh in meshes])
        super().__init__(launcher, faces.min(axis=1) - around, faces.max(axis=1) + around, counts, leaf=NODE_WIDTH)
        numbers = self.order - np.repeat(np.cumsum(counts) - counts, counts)
        lanes = self.firsts[:, None] + np.arange(NODE_WIDTH)
        is_used = lanes < np.append(self.firsts[1:], len(faces))[:, None]
        lanes[~is_used] = 0
        table = np.zeros(len(lanes), dtype=table_dtype(TriangleLeaf))
        for (k, corner), (axis, name) in itertools.product(enumerate("abc"), enumerate("xyz")):
            table[f"{corner}_{name}"] = np.where(is_used, faces[self.order[lanes], k, axis], 0.0)
        table["face"] = np.where(is_used, numbers[lanes], -1)
        self.leaves = self._buffers.upload("leaves", TriangleLeaf, table)


class MeshBvhScene:
    """BVHs of a scene's meshes, built when rays first need them.

    The BVH over the instances is refitted when instances move.

    Args:
        launcher: Runs the kernels.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._trees: list[TriangleTrees] = []
        self._instances: HostBoxTree | None = None
        self._synced: object = None
        self.data = MeshBvh()
        """The BVHs in the struct that kernels get. Must not be traversed if the scene has no meshes."""
        self.boxes = InstanceBoxes.none()
        """World-space box and BVH root of each mesh instance."""

    @property
    def bytes(self) -> int:
        """Device memory of the BVHs, bytes."""
        above = [self._instances] if self._instances else []
        table = bytes_of(self.data.assets) if self._trees else 0
        return table + sum(tree.bytes for tree in (*self._trees, *above))

    @property
    def graph_key(self) -> object:
        """Key of the device addresses that kernels get by value. A recorded CUDA graph with another key is stale."""
        return [trees.build for trees in self._trees], self._instances and self._instances.build

    def sync(self, scene: Scene) -> None:
        """Builds BVHs of new meshes; refits or rebuilds the BVH over the instances if they have moved."""
        if not scene.meshes:
            self._trees, self._instances, self._synced = [], None, None
            self.boxes = InstanceBoxes.none()
            return
        meshes = {id(instance.mesh): instance.mesh for instance in scene.meshes}
        self._sync_trees(meshes)
        roots_of = {
            key: (asset, root) for asset, trees in enumerate(self._trees) for key, root in trees.root_of.items()
        }
        assets, roots = np.array([roots_of[id(instance.mesh)] for instance in scene.meshes]).T
        transforms = np.array([instance.transform for instance in scene.meshes])
        synced = assets.tobytes(), roots.tobytes(), transforms.tobytes(), [trees.build for trees in self._trees]
        if synced == self._synced:
            return  # nothing has changed
        self._synced = None  # in case building fails halfway
        corners = np.concatenate([trees.corners for trees in self._trees])
        firsts = np.cumsum([0, *(len(trees.corners) for trees in self._trees)])
        low, high = world_boxes(corners[firsts[assets] + roots], transforms)
        self.boxes = InstanceBoxes(assets, roots, low, high)
        self._instances = self._tree_over(self._instances)
        self.data.tlas_nodes, self.data.tlas_order = self._instances.nodes, self._instances.items
        self._synced = synced

    def _sync_trees(self, meshes: dict[int, Mesh]) -> None:
        """Builds BVHs of new meshes together; drops a group of BVHs built together once all its meshes are unused."""
        used = [trees for trees in self._trees if trees.root_of.keys() & meshes.keys()]
        existing = {key for trees in used for key in trees.root_of}
        missing = [mesh for key, mesh in meshes.items() if key not in existing]
        if missing:
            used.append(TriangleTrees(self._launcher, missing))
        if [trees.build for trees in used] == [trees.build for trees in self._trees]:
            return
        rows: list[TriangleBvh] = []
        for trees in used:
            row = TriangleBvh()
            row.nodes, row.leaves = trees.nodes, trees.leaves
            rows.append(row)
        self.data.assets = upload_structs(rows, TriangleBvh, self._launcher.device)
        self._trees = used

    def _tree_over(self, before: HostBoxTree | None) -> HostBoxTree:
        """Returns the BVH over the instances: ``before`` refitted, or a new one if surface area has grown too much."""
        low, high = self.boxes.low, self.boxes.high
        if before is not None and len(before.order) == len(low):
            before.refit(low, high)
            if before.cost <= REBUILD_COST * before.cost_built:
                return before
        return HostBoxTree(self._launcher, low, high, np.array([len(low)]))


@dataclass(frozen=True, slots=True)
class InstanceBoxes:
    """World-space boxes and BVH roots of a scene's mesh instances; one element for each instance."""

    assets: npt.NDArray[np.int64]
    """Index of the group of meshes (TriangleBvh) that contains each instance's triangles."""
    roots: npt.NDArray[np.int64]
    """Index of the root node of each instance's mesh among the nodes of its TriangleBvh."""
    low: Doubles
    """Lower corner of each of N instances' world-space box, shape (N, 3)."""
    high: Doubles

    @classmethod
    def none(cls) -> InstanceBoxes:
        """Returns the boxes of a scene without meshes."""
        return cls(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


def world_boxes(corners: Doubles, transforms: Doubles) -> tuple[Doubles, Doubles]:
    """Returns world-space boxes around N mesh instances, with a margin for rounding errors of rays.

    Args:
        corners: Corners of the boxes around the meshes, object space, shape (N, 8, 3).
        transforms: World-from-object transforms of the instances, shape (N, 4, 4).

    Returns:
        Lower and upper corner of each box, shape (N, 3) each.
    """
    world = corners @ transforms[:, :3, :3].transpose(0, 2, 1) + transforms[:, None, :3, 3]
    low, high = world.min(axis=1), world.max(axis=1)
    largest = np.abs(world).max(axis=(1, 2))
    margin = INSTANCE_BOX_MARGIN * np.linalg.norm(high - low, axis=1) + RAY_START_BACK * largest
    return low - margin[:, None], high + margin[:, None]
