"""The scene's Gaussians as rays meet them: a tree an asset, and over them a tree of the instances."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lumisplat.config import RenderConfig
from lumisplat.constants import BOX_MARGIN, COHERENT_RADIUS, KERNEL_LINEAR_SLOPE, NODE_WIDTH
from lumisplat.device.structs.bvh import FAR, NO_CHILD, AssetBvh, BvhInstance, KernelData, Node
from lumisplat.device.structs.scene import GaussianData
from lumisplat.errors import DeviceError
from lumisplat.renderer.scene.device_scene import DeviceScene, SplatAsset, table_dtype
from lumisplat.renderer.scene.gaussian_bvh import GaussianBvh
from lumisplat.renderer.scene.materials import shading_overrides
from lumisplat.renderer.scene.upload import upload_structs
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class HeldBvh:
    """The tree of an asset."""

    gaussians: Gaussians
    data: GaussianData
    """Its arrays on the device, which may be others when it is uploaded again."""
    kernel: KernelData
    tree: GaussianBvh


class BvhScene:
    """Trees of a scene's Gaussians, built when rays first meet them, and refitted when their Gaussians move.

    Args:
        launcher: Runs the kernels.
    """

    def __init__(self, launcher: Launcher) -> None:
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self._held: list[HeldBvh] = []
        self.assets: Any = None
        """What the instances place, as TreeAsset."""
        self.instances: Any = None
        """In scene order, as TreeInstance."""
        self.tlas_nodes: Any = None
        """Tree of the instances' world boxes; its leaves are ~instance."""

        self._placed: bytes | None = None
        self.packet_radius = 0.0
        """Rays of a packet that start farther apart than this are not traced together, world space."""

    @property
    def bytes(self) -> int:
        """Memory of the trees, bytes."""
        return self._buffers.bytes + sum(held.tree.bytes for held in self._held)

    @property
    def held(self) -> list[HeldBvh]:
        """The trees, in the order of the device scene's assets."""
        return self._held

    def sync(self, scene: Scene, device_scene: DeviceScene, config: RenderConfig, *, lit: bool = False) -> None:
        """Builds or refits what changed, and writes where the instances are.

        Args:
            scene: What ``device_scene`` was synchronised with last.
            device_scene: Its Gaussians on the device.
            config: Its kernel settings are those that the bounds follow.
            lit: Whether the frame is; then sets that reflect light show their own albedo and normals.
        """
        assets = device_scene.assets
        if [id(asset.data) for asset in assets] != [id(held.data) for held in self._held]:
            before, self._held = self._held, []  # until all are there: a tree may have moved on when the next one fails
            self._placed = None
            try:
                self._held = [self._tree_of(place, assets, before, config) for place in range(len(assets))]
                rows = self._asset_rows() or [AssetBvh()]  # an array without elements has no address
                self.assets = upload_structs(rows, AssetBvh, self._launcher.device)
            except DeviceError:
                raise
            except RuntimeError as error:  # Warp's own, of what its sorts and sums allocate
                raise DeviceError(f"{self._launcher.device} has no room for the scene's trees: {error}") from None
        place_of = {id(held.gaussians): place for place, held in enumerate(self._held)}
        places = [place_of[id(instance.gaussians)] for instance in scene.splats]
        table = self._instance_table(scene, places, config, lit) if places else np.zeros(0)
        if table.tobytes() == self._placed:
            return  # nothing has moved
        self._placed = None  # until all of it is there
        self.instances = self._buffers.get("instances", BvhInstance, len(places))
        if places:
            self.instances.assign(table)
        extents = (self._held[p].tree.extent * i.scale for i, p in zip(scene.splats, places, strict=True))
        self.packet_radius = COHERENT_RADIUS * max(extents, default=0.0)
        nodes = tree_of_boxes(*self._world_boxes(scene, places))
        self.tlas_nodes = self._buffers.get("tlas_nodes", Node, len(nodes))
        self.tlas_nodes.assign(nodes)
        self._placed = table.tobytes()

    def _tree_of(self, place: int, assets: list[SplatAsset], before: list[HeldBvh], config: RenderConfig) -> HeldBvh:
        """The tree that there is; that of the asset whose place this one took, refitted; or a new one."""
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
            there.tree.refit(data)
            return HeldBvh(gaussians, data, kernel, there.tree)
        return HeldBvh(gaussians, data, kernel, GaussianBvh(self._launcher, data, kernel))

    def _asset_rows(self) -> list[AssetBvh]:
        rows = []
        for held in self._held:
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = held.tree.nodes, held.tree.particles, held.data
            rows.append(row)
        return rows

    def _instance_table(self, scene: Scene, places: list[int], config: RenderConfig, lit: bool) -> np.ndarray:
        world_from_object = np.array([instance.transform for instance in scene.splats])
        object_from_world = np.linalg.inv(world_from_object)
        scales = np.array([instance.scale for instance in scene.splats])
        table = np.zeros(len(places), dtype=table_dtype(BvhInstance))
        table["object_from_world"] = object_from_world[:, :3, :3]
        table["object_from_world_offset"] = object_from_world[:, :3, 3]
        table["world_from_object"] = world_from_object[:, :3, :3] / scales[:, None, None]
        table["first"] = np.cumsum([0, *(instance.gaussians.count for instance in scene.splats[:-1])])
        table["asset"] = places
        table["shadow_only"] = [instance.shadow_only for instance in scene.splats]
        table["sh_degree"] = [min(config.trace.sh_degree, instance.sh_degree) for instance in scene.splats]
        for name, values in shading_overrides(scene, lit).items():
            table[name] = values
        for row, place in zip(table, places, strict=True):
            kernel = self._held[place].kernel
            for name in ("degree", "falloff", "min_response", "adaptive"):
                row["kernel"][name] = getattr(kernel, name)
        return table

    def _world_boxes(self, scene: Scene, places: list[int]) -> tuple[np.ndarray, np.ndarray]:
        bounds = [held.tree.bounds() for held in self._held]
        lows, highs = np.full((len(places), 3), FAR), np.full((len(places), 3), -FAR)
        for i, (instance, place) in enumerate(zip(scene.splats, places, strict=True)):
            low, high = bounds[place]
            if (low <= high).all():
                corners = np.array(list(itertools.product(*zip(low, high, strict=True))))
                world = corners @ instance.transform[:3, :3].T + instance.transform[:3, 3]
                margin = BOX_MARGIN * np.abs(world).max(axis=0)
                lows[i], highs[i] = world.min(axis=0) - margin, world.max(axis=0) + margin
        return lows, highs


def kernel_data(gaussians: Gaussians, config: RenderConfig) -> KernelData:
    """How the Gaussians of a capture respond: by the setting, or by the capture's own degree."""
    trace = config.trace
    kernel = KernelData()
    kernel.degree = gaussians.kernel_degree if trace.kernel_degree is None else trace.kernel_degree
    kernel.falloff = KERNEL_LINEAR_SLOPE if kernel.degree == 0 else 4.5 / 3.0**kernel.degree
    kernel.min_response = trace.min_response
    kernel.adaptive = int(trace.adaptive_clamping)
    return kernel


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
