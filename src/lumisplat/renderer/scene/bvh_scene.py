"""BVHs of the scene's Gaussians: one for each asset (Gaussian set), and top-level BVHs over the splat instances."""

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
"""Largest distance of a ray's origin from the origin of its packet's first ray, as a fraction of the scene's largest
capture. Rays that start farther away are traced separately."""


class SplatSets(Enum):
    """Subsets of a scene's splat sets, to which the hits of rays can be restricted."""

    ALL = "all"
    CAPTURED = "captured"
    """Splat sets that emit their captured colours."""
    RELIT = "relit"
    """Splat sets that are relit: all sets that do not emit their captured colours."""
    SHADOW_CATCHERS = "shadow_catchers"
    """Splat sets that are shadow catchers; they are also among the sets that emit captured colours."""

    def has(self, instance: SplatInstance) -> bool:
        """Returns whether the set of a splat instance belongs to the subset."""
        if self is SplatSets.SHADOW_CATCHERS:
            return instance.shadow_catcher
        return self is SplatSets.ALL or is_relit(instance) == (self is SplatSets.RELIT)


@dataclass(frozen=True, slots=True)
class CachedBvh:
    """The BVH of an asset, and the data from which it was built."""

    gaussians: Gaussians
    data: GaussianData
    """Device arrays of the asset from which the BVH was built. An asset that is uploaded again has other arrays."""
    kernel: KernelData
    bvh: GaussianBvh


class BvhScene:
    """BVHs of a scene's Gaussians, built when rays first need them, and refitted when Gaussians move.

    Args:
        launcher: Runs the kernels.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self._cached: list[CachedBvh] = []
        self.assets: DeviceArray | None = None
        """``AssetBvh`` of each asset, as a table for kernels; None before the first ``sync``."""
        self._tlas_nodes: dict[SplatSets, DeviceArray] = {}
        """Nodes of the top-level BVH over the world boxes of the instances in each subset; leaf i is the link ``~i``
        (bitwise not)."""
        self._synced: tuple[list[int], list[bytes], dict[SplatSets, list[bool]]] | None = None
        self.footprint = 0.0
        """Standard deviation, in pixel widths, by which rays widen Gaussians: the largest over all instances."""
        self.hit_distance = HIT_PEAK
        """Where on a ray kernels compute hits: HIT_MEAN if any instance uses the mean, else the instances' common
        HIT_PEAK or HIT_HULL.
        """
        self.stack = TRAVERSE_STACK_SMALL
        """Number of stack entries that CUDA kernels need to traverse the BVHs: `TRAVERSE_STACK_SMALL` if that
        suffices, else `TRAVERSE_STACK`."""
        self.extent = 0.0
        """Largest diagonal, among all instances, of a box around nearly all means of an instance, world space."""
        self.packet_radius = 0.0
        """Largest distance of a ray's origin from its packet's first ray, world space; rays farther away are traced
        separately."""

    @property
    def bytes(self) -> int:
        """Device memory of the BVHs, bytes."""
        return self._buffers.bytes + sum(cached.bvh.bytes for cached in self._cached)

    def data(self, instances: DeviceArray, sets: SplatSets = SplatSets.ALL) -> SceneBvh:
        """Returns the struct that kernels traverse.

        Args:
            instances: The scene's splat instances, an array of SplatInstanceData.
            sets: Splat sets that rays can hit; only path-traced frames have other subsets than ``ALL``.
        """
        row = SceneBvh()
        row.tlas_nodes, row.instances = self._tlas_nodes[sets], instances
        if self.assets is not None:
            row.assets = self.assets
        row.packet_radius, row.footprint, row.hit_distance = self.packet_radius, self.footprint, self.hit_distance
        return row

    @property
    def graph_key(self) -> object:
        """Values that are compiled into a recorded CUDA graph; if any changes, the graph must be recorded again."""
        if self.assets is None:
            return None
        # `stack` depends on the builds and on the top level, whose array may keep its address.
        arrays = [(array.ptr, array.shape) for array in (self.assets, *self._tlas_nodes.values())]
        rays = self.packet_radius, self.footprint, self.hit_distance
        return arrays, [cached.bvh.build for cached in self._cached], self.stack, rays

    @property
    def cached(self) -> list[CachedBvh]:
        """BVHs of the assets, in the order of the assets."""
        return self._cached

    def sync(
        self, scene: Scene, assets: list[SplatAsset], config: RenderConfig, *, is_lit: bool, has_subsets: bool
    ) -> None:
        """Builds or refits BVHs whose Gaussians changed, and rebuilds the top-level BVHs if an instance has moved.

        Args:
            scene: The scene with the instances.
            assets: The scene's Gaussian sets on the device.
            config: Settings; its kernel response determines the bounds of Gaussians.
            is_lit: Whether the frame is lit.
            has_subsets: Whether rays may be restricted to subsets of the splat sets.

        Raises:
            DeviceError: The device is out of memory.
        """
        wanted = [(id(asset.gaussians), id(asset.data)) for asset in assets]
        if wanted != [(id(cached.gaussians), id(cached.data)) for cached in self._cached]:
            before, self._cached = (
                self._cached,
                [],
            )  # cleared until all are built: some may be refitted when the next one fails
            self._synced = None
            try:
                self._cached = [self._bvh_of(index, assets, before, config) for index in range(len(assets))]
                self.assets = self._buffers.table("assets", AssetBvh, self._asset_rows() or [AssetBvh()])
            except DeviceError:
                raise
            except RuntimeError as error:  # Warp raises it when its sorts and scans cannot allocate
                raise DeviceError(
                    f"{self._launcher.device} has too little memory for the scene's BVHs: {error}"
                ) from None
        index_of = {id(cached.gaussians): index for index, cached in enumerate(self._cached)}
        asset_indices = [index_of[id(instance.gaussians)] for instance in scene.splats]
        kinds = tuple(SplatSets) if has_subsets else (SplatSets.ALL,)
        members = {kind: [kind.has(instance) for instance in scene.splats] for kind in kinds}
        synced = asset_indices, [instance.transform.tobytes() for instance in scene.splats], members
        self.footprint = max((footprint_of(instance.gaussians, config) for instance in scene.splats), default=0.0)
        self.hit_distance = common_hit_distance(scene, config, is_lit=is_lit)
        if synced != self._synced:
            self._synced = None  # cleared until all is built
            self._build_top_levels(scene, asset_indices, members)
            self._synced = synced

    def refit(self, scene: Scene) -> None:
        """Refits the BVHs to Gaussians that were overwritten in place, or whose arrays were replaced.

        Args:
            scene: The scene of the last ``sync``.
        """
        assert self._synced is not None
        asset_indices, _, members = self._synced
        for cached in self._cached:
            cached.bvh.refit(cached.data)
        self.assets = self._buffers.table("assets", AssetBvh, self._asset_rows() or [AssetBvh()])
        self._build_top_levels(scene, asset_indices, members)

    def _build_top_levels(self, scene: Scene, asset_indices: list[int], members: dict[SplatSets, list[bool]]) -> None:
        """Builds, for each subset of the splat sets, the top-level BVH over its instances.

        Args:
            scene: The scene with the instances.
            asset_indices: Index of the asset of each instance.
            members: For each subset, whether each instance belongs to it.
        """
        extents = (self._cached[p].bvh.extent * i.scale for i, p in zip(scene.splats, asset_indices, strict=True))
        self.extent = max(extents, default=0.0)
        self.packet_radius = COHERENT_RADIUS * self.extent
        boxes = self._world_boxes(scene, asset_indices)
        trees = {kind: tree_of_boxes(*boxes_of_members(boxes, chosen)) for kind, chosen in members.items()}
        waiting = max(waiting_in_tree(nodes) for nodes in trees.values())
        needed = waiting - 1 + max((cached.bvh.stack_size for cached in self._cached), default=1)
        self.stack = TRAVERSE_STACK_SMALL if needed <= TRAVERSE_STACK_SMALL else TRAVERSE_STACK
        self._tlas_nodes = {
            kind: self._buffers.get(f"tlas_nodes.{kind.value}", Node, len(nodes)) for kind, nodes in trees.items()
        }
        for kind, nodes in trees.items():
            assign_table(self._tlas_nodes[kind], nodes)

    def _bvh_of(self, index: int, assets: list[SplatAsset], before: list[CachedBvh], config: RenderConfig) -> CachedBvh:
        """Returns the BVH of asset ``index``: the cached one, a refit of the replaced asset's BVH, or a new one."""
        gaussians, data = assets[index].gaussians, assets[index].data
        cached = next((cached for cached in before if cached.gaussians is gaussians), None)
        if cached is not None:
            return replace(cached, data=data)
        kernel = kernel_data(gaussians, config)
        used = {id(asset.gaussians) for asset in assets}
        previous = before[index] if index < len(before) else None
        if (
            previous is not None
            and id(previous.gaussians) not in used
            and previous.gaussians.count == gaussians.count
            and previous.kernel.degree == kernel.degree
        ):
            previous.bvh.refit(data)
            return CachedBvh(gaussians, data, kernel, previous.bvh)
        return CachedBvh(gaussians, data, kernel, GaussianBvh(self._launcher, data, kernel))

    def _asset_rows(self) -> list[AssetBvh]:
        rows: list[AssetBvh] = []
        for cached in self._cached:
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = cached.bvh.nodes, cached.bvh.particles, cached.data
            rows.append(row)
        return rows

    def _world_boxes(self, scene: Scene, asset_indices: list[int]) -> tuple[np.ndarray, np.ndarray]:
        bounds = [cached.bvh.bounds() for cached in self._cached]
        lows, highs = np.full((len(asset_indices), 3), FAR), np.full((len(asset_indices), 3), -FAR)
        for i, (instance, index) in enumerate(zip(scene.splats, asset_indices, strict=True)):
            low, high = bounds[index]
            if (low <= high).all():
                corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
                world = corners @ instance.transform[:3, :3].T + instance.transform[:3, 3]
                margin = BOX_MARGIN * np.abs(world).max(axis=0)
                lows[i], highs[i] = world.min(axis=0) - margin, world.max(axis=0) + margin
        return lows, highs


def common_hit_distance(scene: Scene, config: RenderConfig, *, is_lit: bool) -> int:
    """Returns where on a ray kernels compute hits: HIT_MEAN if any instance uses it, else the common one of all."""
    hit_distances = {hit_distance_of(instance, config, is_lit=is_lit) for instance in scene.splats}
    return HIT_MEAN if HIT_MEAN in hit_distances else next(iter(hit_distances), HIT_PEAK)


def boxes_of_members(boxes: tuple[np.ndarray, np.ndarray], members: list[bool]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the boxes, inverted (low above high) for non-members, so that `tree_of_boxes` leaves these out."""
    chosen = np.array(members, bool)[:, None]
    return np.where(chosen, boxes[0], FAR), np.where(chosen, boxes[1], -FAR)


def tree_of_boxes(lows: np.ndarray, highs: np.ndarray) -> np.ndarray:
    """Builds a small BVH on the host: each node's boxes are split into up to `NODE_WIDTH` children.

    Args:
        lows: Lower corners of M boxes, shape (M, 3).
        highs: Upper corners of the boxes, shape (M, 3); inverted boxes are left out.

    Returns:
        Nodes, the root first; the link to box i is ``~i`` (bitwise not).
    """
    rows: list[np.ndarray] = []

    def add(items: np.ndarray) -> int:
        row = empty_node()
        rows.append(row)
        number = len(rows) - 1
        for c, group in enumerate(_split(items, lows + highs)):
            for k, axis in enumerate("xyz"):
                row[f"low_{axis}"][0, c] = lows[group, k].min()
                row[f"high_{axis}"][0, c] = highs[group, k].max()
            row["link"][0, c] = ~group[0] if len(group) == 1 else add(group)
        return number

    add(np.flatnonzero((lows <= highs).all(axis=1)))
    return np.concatenate(rows)


def waiting_in_tree(nodes: np.ndarray) -> int:
    """Returns the stack size that a traversal of a small BVH needs, whatever the order in which it visits children."""
    waiting = np.ones(len(nodes), dtype=np.int64)
    for number in reversed(range(len(nodes))):  # children come after their parents
        links: list[int] = nodes["link"][number].tolist()
        below = [int(waiting[link]) if link >= 0 else 1 for link in links if link != NO_CHILD]
        waiting[number] = max(1, len(below) - 1 + max(below, default=0))
    return int(waiting[0])


def empty_node() -> np.ndarray:
    """Returns a BVH node without children, as a table with one row."""
    row = np.zeros(1, dtype=table_dtype(Node))
    for axis in "xyz":
        row[f"low_{axis}"], row[f"high_{axis}"] = FAR, -FAR
    row["link"] = NO_CHILD
    return row


def _split(items: np.ndarray, centers: np.ndarray) -> list[np.ndarray]:
    """Halves the largest group of ``items`` at the median of their centres until `NODE_WIDTH` groups exist.

    Each half is cut along the axis in which the centres spread most; groups of one item stay whole.
    """
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
