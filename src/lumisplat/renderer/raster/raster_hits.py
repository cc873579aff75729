"""Finds primary hits by rasterisation, and returns them in the ray tracer's format."""

from __future__ import annotations

from lumisplat.config import RasterStrategy, RenderConfig
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits, RayData
from lumisplat.renderer.raster import relit_kernels
from lumisplat.renderer.raster.binning import Binning
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.splat_raster import SplatRaster
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher


class RasterHits:
    """Rasterises meshes and splats, and stores what camera rays hit.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        binning: Sorts splats and lists them per tile.
        meshes: Rasterises meshes.
        splats: Rasterises splats.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        config: RenderConfig,
        *,
        binning: Binning,
        meshes: MeshRaster,
        splats: SplatRaster,
    ) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._is_sorted = config.raster.strategy is RasterStrategy.SORTED
        self._binning, self._meshes, self._splats = binning, meshes, splats

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        counts = self._is_sorted and "hits" in self._config.aovs
        modules = self._splats.modules(is_sorted=self._is_sorted, counts=counts, merges_sets=plan.merges_sets)
        modules += [relit_kernels] if self._is_sorted and plan.mixes_sets else []
        modules += [relit_kernels.MEANS] if plan.has_mean_surface else []
        return [*modules, *self._meshes.modules(has_meshes=plan.has_meshes)]

    def find_hits(self, scene: DeviceScene, rays: RayData) -> PrimaryHits:
        """Returns the hits of the current sample's camera rays by rasterisation.

        If `Binning.finish` returns False, a tile list was too short, and the hits are incomplete.

        Args:
            scene: The device scene at this sample, with a pinhole camera without aperture.
            rays: The camera rays of the sample, one for each pixel.
        """
        stage = self._launcher.stage
        gaussians = self._buffers.struct("raster.gaussians", GaussianHits, len(rays.t_max), EXTRA_FIELDS)
        self._binning.begin()
        with stage("mesh"):
            pixels, meshes = self._meshes.find_hits(scene, rays)
        with stage("project"):
            splats = self._splats.project(scene)
        with stage("sort"):
            order = self._binning.sort(splats.keys) if self._is_sorted else self._binning.unsorted(splats.count)
        with stage("bin"):
            tiles = self._splats.bin(scene, order, splats)
        with stage("composite"):
            if self._is_sorted:
                counts = "hits" in self._config.aovs
                self._splats.find_hits(scene, tiles, pixels, gaussians, counts=counts)
                if scene.plan.mixes_sets:
                    self._splats.find_relit(scene, tiles, pixels, gaussians)
                if scene.plan.has_mean_surface:
                    self._splats.find_means(scene, splats, tiles, pixels, gaussians)
            else:
                self._splats.sample_hits(scene, tiles, pixels, gaussians)
        return PrimaryHits(rays, meshes, gaussians)
