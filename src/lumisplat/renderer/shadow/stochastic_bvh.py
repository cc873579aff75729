"""Host pass: trees for one stochastic sample of shadows.

For one sample, a Gaussian is an opaque ellipsoid: it ends where its alpha is below the number drawn for it, mostly far
inside of where it ends altogether, or it is not there at all. Trees that follow that are met by a fraction of the
rays. They only save time: what rays meet in them is decided by the numbers themselves.
"""

from __future__ import annotations

from typing import Any

from lumisplat.constants import SHRINK_INSTANCES_MAX, SHRINK_RAYS_PER_GAUSSIAN
from lumisplat.device.structs.bvh import AssetBvh, Node
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.upload import upload_structs
from lumisplat.renderer.shadow import stochastic_bvh_kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


class StochasticBvh:
    """Keeps the trees of the last sample.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        name: Of the buffers.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, name: str) -> None:
        self._launcher, self._buffers, self._name = launcher, buffers, name
        self._whole: Any = None
        """The assets that the trees were shrunk from."""
        self._assets: Any = None
        self._nodes: list[Any] = []
        self._is_fresh = False
        self._rays = 0
        """Of the sample so far."""

    def forget(self) -> None:
        """Another sample begins."""
        self._is_fresh, self._rays = False, 0

    def assets(self, scene: DeviceScene, trees: BvhScene, settings: Any, *, ray_count: int) -> Any:
        """The scene's assets with trees for the sample that ``settings`` tell; the whole trees while few rays came."""
        if trees.assets is self._whole and self._is_fresh:
            return self._assets
        self._rays += ray_count
        if self._rays < SHRINK_RAYS_PER_GAUSSIAN * scene.gaussian_count:
            return trees.assets
        nodes = []
        for place, (asset, held) in enumerate(zip(scene.assets, trees.held, strict=True)):
            tree = held.tree
            if asset.instance_ids.shape[0] > SHRINK_INSTANCES_MAX:
                nodes.append(tree.nodes)
                continue
            nodes.append(self._buffers.get(f"{self._name}.nodes{place}", Node, tree.nodes.shape[0]))
            for first, count in reversed(tree.levels):
                self._launcher.run_banded(
                    stochastic_bvh_kernels.shrink_nodes,
                    count,
                    *(first, settings, asset.instance_ids, trees.instances, tree.particles, tree.nodes, nodes[-1]),
                )
        if trees.assets is not self._whole or [n.ptr for n in nodes] != [n.ptr for n in self._nodes]:
            self._assets = self._upload(trees, nodes)
            self._whole, self._nodes = trees.assets, nodes
        self._is_fresh = True
        return self._assets

    def _upload(self, trees: BvhScene, nodes: list[Any]) -> Any:
        rows = []
        for held, shrunk in zip(trees.held, nodes, strict=True):
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = shrunk, held.tree.particles, held.data
            rows.append(row)
        return upload_structs(rows or [AssetBvh()], AssetBvh, self._launcher.device)
