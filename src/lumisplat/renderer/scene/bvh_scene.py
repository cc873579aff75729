"""The scene's Gaussians as rays hit them: a bounding volume hierarchy (BVH) an asset, and one over the instances."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.constants import BOX_MARGIN, NODE_WIDTH, TRAVERSE_STACK, TRAVERSE_STACK_SMALL
from lumisplat.device.structs.bvh import FAR, HIT_MEAN, HIT_PEAK, NO_CHILD, AssetBvh, Node, SceneBvh
from lumisplat.device.structs.scene import GaussianData, KernelData
from lumisplat.errors import DeviceError
from lumisplat.renderer.scene.assets import SplatAsset
from lumisplat.renderer.scene.instance_tables import footprint_of, hit_distance_of, kernel_data
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.renderer.trees.gaussian_bvh import GaussianBvh
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance

COHERENT_RADIUS = 0.03
"""Rays of a packet are not traced with its first one if their origins differ from that one's by more than this share of
the scene's largest capture."""


class SplatSets(Enum):
    """Which splat sets of a scene rays meet."""

    ALL = "all"
    KEPT = "kept"
    """Those that keep their captured colours."""
    RELIT = "relit"
    """The others."""
    SHADOW_ONLY = "shadow_only"
    """A part of the kept ones."""

    def has(self, instance: SplatInstance) -> bool:
        """Whether an instance is one of them."""
        if self is SplatSets.SHADOW_ONLY:
            return instance.shadow_catcher
        return self is SplatSets.ALL or is_relit(instance) == (self is SplatSets.RELIT)


@dataclass(frozen=True, slots=True)
class HeldBvh:
    """The BVH of an asset."""

    gaussians: Gaussians
    data: GaussianData
    """Its arrays on the device, which may be others when it is uploaded again."""
    kernel: KernelData
    bvh: GaussianBvh


class BvhScene:
    """BVHs of a scene's Gaussians, built when rays first need them, and refitted when their Gaussians move.

    Args:
        launcher: Runs the kernels.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self._held: list[HeldBvh] = []
        self.assets: DeviceArray | None = None
        """What the instances place, as AssetBvh."""
        self._tlas_nodes: dict[SplatSets, DeviceArray] = {}
        """Top levels: trees of the instances' world boxes; their leaves are ~instance."""
        self._placed: tuple[list[int], list[bytes], dict[SplatSets, list[bool]]] | None = None
        self.footprint = 0.0
        """The widest footprint of the instances, in widths of a pixel."""
        self.hit_distance = HIT_PEAK
        """That of the instances; HIT_MEAN if it is that of any."""
        self.stack = TRAVERSE_STACK_SMALL
        """Entries of the stack with which CUDA's kernels traverse the trees: enough, and one of two numbers."""
        self.extent = 0.0
        """Size of the largest instance, world space."""
        self.packet_radius = 0.0
        """Rays of a packet that start farther apart than this are not traced together, world space."""

    @property
    def bytes(self) -> int:
        """Memory of the BVHs, bytes."""
        return self._buffers.bytes + sum(held.bvh.bytes for held in self._held)

    def data(self, instances: DeviceArray, sets: SplatSets = SplatSets.ALL) -> SceneBvh:
        """What kernels traverse.

        Args:
            instances: The scene's, an array of SplatInstanceData.
            sets: Those that rays meet; some only of frames of paths.
        """
        row = SceneBvh()
        row.tlas_nodes, row.instances = self._tlas_nodes[sets], instances
        if self.assets is not None:
            row.assets = self.assets
        row.packet_radius, row.footprint, row.hit_distance = self.packet_radius, self.footprint, self.hit_distance
        return row

    @property
    def graph_key(self) -> object:
        """What kernels get of it by value: captured graphs are stale after a change."""
        if self.assets is None:
            return None
        # `stack` follows from the builds and from the tree over the instances, which may keep its memory.
        arrays = [(array.ptr, array.shape) for array in (self.assets, *self._tlas_nodes.values())]
        rays = self.packet_radius, self.footprint, self.hit_distance
        return arrays, [held.bvh.build for held in self._held], self.stack, rays

    @property
    def held(self) -> list[HeldBvh]:
        """The assets' BVHs, in their order."""
        return self._held

    def sync(
        self, scene: Scene, assets: list[SplatAsset], config: RenderConfig, *, is_lit: bool, tells_apart: bool
    ) -> None:
        """Builds or refits what changed, and the top levels if an instance has moved.

        Args:
            scene: What places the assets.
            assets: Its Gaussians on the device.
            config: Its kernel settings are those that the bounds follow.
            is_lit: Whether the frame is lit.
            tells_apart: Whether rays may meet some of `SplatSets` alone.

        Raises:
            DeviceError: The device is out of memory.
        """
        wanted = [(id(asset.gaussians), id(asset.data)) for asset in assets]
        if wanted != [(id(held.gaussians), id(held.data)) for held in self._held]:
            before, self._held = self._held, []  # until all are there: one may be refitted when the next one fails
            self._placed = None
            try:
                self._held = [self._bvh_of(place, assets, before, config) for place in range(len(assets))]
                self.assets = self._buffers.table("assets", AssetBvh, self._asset_rows() or [AssetBvh()])
            except DeviceError:
                raise
            except RuntimeError as error:  # Warp's own, of what its sorts and sums allocate
                raise DeviceError(f"{self._launcher.device} has no room for the scene's trees: {error}") from None
        place_of = {id(held.gaussians): place for place, held in enumerate(self._held)}
        places = [place_of[id(instance.gaussians)] for instance in scene.splats]
        kinds = tuple(SplatSets) if tells_apart else (SplatSets.ALL,)
        members = {kind: [kind.has(instance) for instance in scene.splats] for kind in kinds}
        placed = places, [instance.transform.tobytes() for instance in scene.splats], members
        self.footprint = max((footprint_of(instance.gaussians, config) for instance in scene.splats), default=0.0)
        hit_distances = {hit_distance_of(instance, config, is_lit=is_lit) for instance in scene.splats}
        self.hit_distance = HIT_MEAN if HIT_MEAN in hit_distances else next(iter(hit_distances), HIT_PEAK)
        if placed != self._placed:
            self._placed = None  # until all of it is there
            self._place(scene, places, members)
            self._placed = placed

    def refit(self, scene: Scene) -> None:
        """Follows Gaussians that were written where they lie, or whose arrays are others, since the last ``sync``.

        Args:
            scene: The one that was synced.
        """
        assert self._placed is not None
        places, _, members = self._placed
        for held in self._held:
            held.bvh.refit(held.data)
        self.assets = self._buffers.table("assets", AssetBvh, self._asset_rows() or [AssetBvh()])
        self._place(scene, places, members)

    def _place(self, scene: Scene, places: list[int], members: dict[SplatSets, list[bool]]) -> None:
        """Builds the top levels.

        Args:
            scene: With the instances.
            places: The asset of each.
            members: Which of them each top level is of.
        """
        extents = (self._held[p].bvh.extent * i.scale for i, p in zip(scene.splats, places, strict=True))
        self.extent = max(extents, default=0.0)
        self.packet_radius = COHERENT_RADIUS * self.extent
        boxes = self._world_boxes(scene, places)
        trees = {kind: tree_of_boxes(*boxes_among(boxes, among)) for kind, among in members.items()}
        waiting = max(waiting_in_tree(nodes) for nodes in trees.values())
        needed = waiting - 1 + max((held.bvh.stack_size for held in self._held), default=1)
        self.stack = TRAVERSE_STACK_SMALL if needed <= TRAVERSE_STACK_SMALL else TRAVERSE_STACK
        self._tlas_nodes = {
            kind: self._buffers.get(f"tlas_nodes.{kind.value}", Node, len(nodes)) for kind, nodes in trees.items()
        }
        for kind, nodes in trees.items():
            assign_table(self._tlas_nodes[kind], nodes)

    def _bvh_of(self, place: int, assets: list[SplatAsset], before: list[HeldBvh], config: RenderConfig) -> HeldBvh:
        """The BVH that is held; that of the asset whose place this one took, refitted; or a new one."""
        gaussians, data = assets[place].gaussians, assets[place].data
        held = next((held for held in before if held.gaussians is gaussians), None)
        if held is not None:
            return replace(held, data=data)
        kernel = kernel_data(gaussians, config)
        used = {id(asset.gaussians) for asset in assets}
        there = before[place] if place < len(before) else None
        if (
            there is not None
            and id(there.gaussians) not in used
            and there.gaussians.count == gaussians.count
            and there.kernel.degree == kernel.degree
        ):
            there.bvh.refit(data)
            return HeldBvh(gaussians, data, kernel, there.bvh)
        return HeldBvh(gaussians, data, kernel, GaussianBvh(self._launcher, data, kernel))

    def _asset_rows(self) -> list[AssetBvh]:
        rows: list[AssetBvh] = []
        for held in self._held:
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = held.bvh.nodes, held.bvh.particles, held.data
            rows.append(row)
        return rows

    def _world_boxes(self, scene: Scene, places: list[int]) -> tuple[np.ndarray, np.ndarray]:
        bounds = [held.bvh.bounds() for held in self._held]
        lows, highs = np.full((len(places), 3), FAR), np.full((len(places), 3), -FAR)
        for i, (instance, place) in enumerate(zip(scene.splats, places, strict=True)):
            low, high = bounds[place]
            if (low <= high).all():
                corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
                world = corners @ instance.transform[:3, :3].T + instance.transform[:3, 3]
                margin = BOX_MARGIN * np.abs(world).max(axis=0)
                lows[i], highs[i] = world.min(axis=0) - margin, world.max(axis=0) + margin
        return lows, highs


def boxes_among(boxes: tuple[np.ndarray, np.ndarray], among: list[bool]) -> tuple[np.ndarray, np.ndarray]:
    """The boxes, as ``tree_of_boxes`` takes them, those left out inverted."""
    chosen = np.array(among, bool)[:, None]
    return np.where(chosen, boxes[0], FAR), np.where(chosen, boxes[1], -FAR)


def tree_of_boxes(lows: np.ndarray, highs: np.ndarray) -> np.ndarray:
    """A small tree, built on the host: groups of boxes are halved along their longest side, as often as there is room.

    Args:
        lows: Lower corners, shape (M, 3).
        highs: Upper corners, shape (M, 3); boxes that are inverted are left out.

    Returns:
        Nodes, the root first; leaves are ~number of the box.
    """
    rows: list[np.ndarray] = []

    def add(items: np.ndarray) -> int:
        row = empty_node()
        rows.append(row)
        number = len(rows) - 1
        for c, group in enumerate(_dealt(items, lows + highs)):
            for k, axis in enumerate("xyz"):
                row[f"low_{axis}"][0, c] = lows[group, k].min()
                row[f"high_{axis}"][0, c] = highs[group, k].max()
            row["link"][0, c] = ~group[0] if len(group) == 1 else add(group)
        return number

    add(np.flatnonzero((lows <= highs).all(axis=1)))
    return np.concatenate(rows)


def waiting_in_tree(nodes: np.ndarray) -> int:
    """How many nodes of a small tree may wait at a time, its leaves among them, whatever the order of visits."""
    waiting = np.ones(len(nodes), dtype=np.int64)
    for number in reversed(range(len(nodes))):  # children come after their parents
        links: list[int] = nodes["link"][number].tolist()
        below = [int(waiting[link]) if link >= 0 else 1 for link in links if link != NO_CHILD]
        waiting[number] = max(1, len(below) - 1 + max(below, default=0))
    return int(waiting[0])


def empty_node() -> np.ndarray:
    """A 1-element table of a node without children."""
    row = np.zeros(1, dtype=table_dtype(Node))
    for axis in "xyz":
        row[f"low_{axis}"], row[f"high_{axis}"] = FAR, -FAR
    row["link"] = NO_CHILD
    return row


def _dealt(items: np.ndarray, centers: np.ndarray) -> list[np.ndarray]:
    """Items in at most as many groups as a node has children."""
    groups = [items] if len(items) else []
    while len(groups) < NODE_WIDTH:
        largest = max(range(len(groups)), key=lambda g: len(groups[g]), default=0)
        if not groups or len(groups[largest]) < 2:
            break
        group = groups[largest]
        spans = np.ptp(centers[group], axis=0)
        ordered = group[np.argsort(centers[group, spans.argmax()], kind="stable")]
        groups[largest : largest + 1] = np.array_split(ordered, 2)
    return groups
