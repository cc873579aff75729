"""Host pass: rasterised pixels as rays that have met something, for whatever goes on from there."""

from __future__ import annotations

from typing import Any

from lumisplat.config import RasterStrategy, RenderConfig
from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits
from lumisplat.renderer.raster.binning import BinningChunked, BinningParallel
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.splat_raster import SplatRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.renderer.trace.gaussian_trace import ray_count
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera


class RasterPrimary:
    """Rasterises meshes and splats into what rays carry.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        order: Sorts and bins.
        meshes: Rasterises meshes.
        splats: Rasterises splats.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        config: RenderConfig,
        *,
        order: BinningChunked | BinningParallel,
        meshes: MeshRaster,
        splats: SplatRaster,
    ) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._order, self._meshes, self._splats = order, meshes, splats

    def look(self, scene: DeviceScene, camera: Camera, lens: Any) -> PrimaryHits:
        """Rays of all pixels for one sample, and what they meet.

        Args:
            scene: After ``sync`` with the same camera and the sample's offset.
            camera: A sharp pinhole.
            lens: The same, as a 1-element LensData array.
        """
        count = ray_count(camera)
        rays = self._buffers.struct("primary.rays", RayData, count)
        radiance = self._buffers.struct("primary.radiance", GaussianHits, count)
        hits = self._draw(scene, camera, lens, rays, radiance)
        while not self._order.finish():
            hits = self._draw(scene, camera, lens, rays, radiance)
        return PrimaryHits(rays, hits, radiance)

    def _draw(
        self, scene: DeviceScene, camera: Camera, lens: Any, rays: RayData, radiance: GaussianHits
    ) -> RayMeshHits:
        stage = self._launcher.stage
        sorts = self._config.raster.strategy is RasterStrategy.SORTED
        self._order.begin()
        with stage("rays"):
            self._launcher.run_banded(camera_ray_kernels.start_rays, rays.t_max.shape[0], lens, rays)
        with stage("mesh"):
            meshes, hits = self._meshes.meet(scene, camera, rays)
        with stage("project"):
            splats, keys, rects = self._splats.project(scene)
        with stage("sort"):
            depth_order = self._order.sort(keys) if sorts else self._order.unsorted(keys.shape[0])
        with stage("bin"):
            lists = self._splats.bin(depth_order, rects, camera)
        with stage("composite"):
            if sorts:
                counts = "hits" in self._config.aovs
                self._splats.radiate(scene, camera, splats, lists, meshes, radiance=radiance, counts=counts)
            else:
                self._splats.pick(scene, camera, splats, lists, meshes, lens=lens, radiance=radiance)
        return hits
