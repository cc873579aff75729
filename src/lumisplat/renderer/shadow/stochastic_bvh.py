"""Host pass: bounding volume hierarchies for one stochastic sample of shadows.

For one sample, a Gaussian is an opaque ellipsoid: it ends where its alpha is below the number drawn for it, mostly far
inside of where it ends altogether, or it is not there at all. Boxes around that are hit by a fraction of the rays. They
only save time: what rays hit in them is decided by the numbers themselves.
"""

from __future__ import annotations

from lumisplat.constants import SHRINK_INSTANCES_MAX, SHRINK_RAYS_PER_GAUSSIAN
from lumisplat.device.structs.bvh import AssetBvh, Node
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.shadow import stochastic_bvh_kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher


class StochasticBvh:
    """Keeps the hierarchies of the last sample.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        name: Of the buffers.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, name: str) -> None:
        self._launcher, self._buffers, self._name = launcher, buffers, name
        self._whole: DeviceArray | None = None
        """The assets whose hierarchies were shrunk."""
        self._assets: DeviceArray | None = None
        self._is_fresh = False
        self._rays = 0
        """Of the sample so far."""

    def begin_sample(self) -> None:
        """Before the rays of another sample."""
        self._is_fresh, self._rays = False, 0

    def assets(self, scene: DeviceScene, settings: DeviceArray, *, ray_count: int) -> DeviceArray | None:
        """The scene's assets for the sample in ``settings``: whole as long as shrinking costs more than it saves."""
        whole = scene.bvh.assets
        if whole is self._whole and self._is_fresh:
            return self._assets
        self._rays += ray_count
        if self._rays < SHRINK_RAYS_PER_GAUSSIAN * scene.gaussian_count:
            return whole
        nodes = self._shrunk_nodes(scene, settings)
        self._assets, self._whole, self._is_fresh = self._upload(scene, nodes), whole, True
        return self._assets

    def _shrunk_nodes(self, scene: DeviceScene, settings: DeviceArray) -> list[DeviceArray]:
        nodes: list[DeviceArray] = []
        for place, (asset, held) in enumerate(zip(scene.assets, scene.bvh.held, strict=True)):
            bvh = held.bvh
            if asset.instance_ids.shape[0] > SHRINK_INSTANCES_MAX:
                nodes.append(bvh.nodes)
                continue
            nodes.append(self._buffers.get(f"{self._name}.nodes{place}", Node, bvh.nodes.shape[0]))
            for first, count in reversed(bvh.levels):
                self._launcher.run_banded(
                    stochastic_bvh_kernels.shrink_nodes,
                    count,
                    *(first, settings, asset.instance_ids, scene.splat_instances, bvh.particles, bvh.nodes, nodes[-1]),
                )
        return nodes

    def _upload(self, scene: DeviceScene, nodes: list[DeviceArray]) -> DeviceArray:
        rows: list[AssetBvh] = []
        for held, shrunk in zip(scene.bvh.held, nodes, strict=True):
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = shrunk, held.bvh.particles, held.data
            rows.append(row)
        return self._buffers.table(f"{self._name}.assets", AssetBvh, rows)
