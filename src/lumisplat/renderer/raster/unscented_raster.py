"""Primary hits for any lens, with Gaussians listed per tile but evaluated along rays, and traced meshes.

The method is 3DGUT (Wu et al. 2025).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import TILE_BANDS_PER_THREAD, TILE_PX
from lumisplat.device.structs.raster import RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import EXTRA_FIELDS, MEAN_FIELDS, GaussianHits, RayData
from lumisplat.renderer.raster import ellipsoid_kernels, ray_splat_kernels as kernels
from lumisplat.renderer.raster.binning import Binning
from lumisplat.renderer.raster.ellipsoids import Ellipsoids
from lumisplat.renderer.raster.splat_raster import ProjectedSplats, SplatTiles
from lumisplat.renderer.scene.camera_table import image_field
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import MeshTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.camera import Camera


@dataclass(frozen=True, slots=True)
class DrawnRaySplats:
    """Rays of a frame's pixels, and the Gaussians that were composited along the rays."""

    splats: ProjectedSplats
    """Projected Gaussians; ``data`` holds ``RaySplat`` structs."""
    tiles: SplatTiles
    rays: RayData
    limits: wp.array[float]
    """Distance at which each ray ends, scene units."""
    hits: GaussianHits
    settings: DeviceArray
    """``RayRasterData`` array with one element: the settings for kernels."""


class UnscentedRaster:
    """Finds the hits of camera rays: on Gaussians by tile lists, on meshes by ray tracing.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
        binning: Sorts Gaussians and lists them per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, binning: Binning) -> None:
        self._launcher, self._buffers, self._config, self._binning = launcher, buffers, config, binning
        self._meshes = MeshTracer(launcher, buffers)
        self._ellipsoids = Ellipsoids(launcher, buffers, config)
        self._table = settings_table(config)
        self._settings = buffers.get("unscented.settings", RayRasterData, 1)
        self.drawn: DrawnRaySplats | None = None
        """Rays and Gaussians of the last frame; None before the first frame."""

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        blended = [kernels.PIXELS if self._is_by_pixel(mixes_sets=plan.mixes_sets) else kernels.TILES]
        if self._ellipsoids.are_used:
            blended = [kernels.ELLIPSOIDS, ellipsoid_kernels]
        meshes = self._meshes.modules(has_meshes=plan.has_meshes)
        return [kernels, *blended, *self._binning.modules(), *meshes]

    def begin_frame(self, camera: Camera) -> None:
        """Uploads the settings again, because some depend on the frame's camera."""
        self._table["field"] = image_field(camera)
        assign_table(self._settings, self._table)

    def find_hits(self, scene: DeviceScene, rays: RayData, centers: RayData | None = None) -> PrimaryHits:
        """Returns the hits of the current sample's camera rays, on Gaussians by tile lists, on meshes by tracing.

        If `Binning.finish` returns False, a tile list was too short, and the hits are incomplete.

        Args:
            scene: The device scene, at this sample.
            rays: The camera rays of the sample, one for each pixel.
            centers: Rays through the pixels' centres, along which Gaussians are evaluated; None: along ``rays``.
        """
        stage = self._launcher.stage
        self._binning.begin()
        with stage("mesh"):
            meshes = self._meshes.find(scene, rays, "unscented.meshes")
        with stage("project"):
            splats = self._project(scene)
        with stage("sort"):
            order = self._binning.sort(splats.keys)
        with stage("bin"):
            tiles_x, tiles_y = scene.tile_grid
            lists = self._binning.bin("raster", order, splats.rects, tiles_x, tiles_x * tiles_y)
            tiles = SplatTiles(splats.data, lists.starts, lists.items, splats.ellipsoids)
        with stage("composite"):
            hits = self._composite(scene, tiles, centers or rays, meshes.t)
        self.drawn = DrawnRaySplats(splats, tiles, centers or rays, meshes.t, hits, self._settings)
        return PrimaryHits(rays, meshes, hits)

    def _is_by_pixel(self, *, mixes_sets: bool) -> bool:
        """Returns whether to composite with one thread per pixel instead of one per tile.

        The kernel with one thread per tile cannot count hits, separate relit sets from other sets, or blend normals of
        ellipsoids.
        """
        return self._launcher.is_parallel or mixes_sets or "hits" in self._config.aovs or self._ellipsoids.are_used

    def _project(self, scene: DeviceScene) -> ProjectedSplats:
        count = scene.gaussian_count
        splats = ProjectedSplats(
            self._buffers.get("unscented.splats", RaySplat, count),
            keys=self._buffers.get("unscented.keys", wp.uint32, count),
            rects=self._buffers.get("unscented.rects", TileRect, count),
            ellipsoids=self._ellipsoids.none,
        )
        for asset in scene.assets:
            self._launcher.run_banded(
                kernels.project_gaussians,
                asset.instanced_count,
                *(scene.splat_camera, self._settings, scene.splat_instances, asset.instance_ids, asset.data),
                *(splats.data, splats.keys, splats.rects),
            )
        return replace(splats, ellipsoids=self._ellipsoids.find(scene, splats.rects))

    def _composite(self, scene: DeviceScene, tiles: SplatTiles, rays: RayData, limits: wp.array[float]) -> GaussianHits:
        fields = MEAN_FIELDS if scene.plan.mixes_sets else EXTRA_FIELDS
        hits = self._buffers.struct("unscented.hits", GaussianHits, len(rays.t_max), fields)
        lists = (tiles.splats, tiles.starts, tiles.items)
        before, after = (scene.splat_camera, self._settings), (*lists, rays, limits, hits)
        count, bands = math.prod(scene.tile_grid), TILE_BANDS_PER_THREAD * self._launcher.threads
        if self._is_by_pixel(mixes_sets=scene.plan.mixes_sets):
            inputs = (*before, scene.splat_instances, *after, tiles.ellipsoids)
            kernel = kernels.composite_ellipsoids if self._ellipsoids.are_used else kernels.composite_pixels
            count *= TILE_PX * TILE_PX
        else:
            kernel, inputs = kernels.composite_tiles, (*before, *after)
        self._launcher.run_banded(kernel, count, *inputs, bands=bands)
        surfaces = (scene.splat_camera, scene.splat_instances, scene.gaussians, rays, limits, hits)
        self._launcher.run_banded(kernels.set_depth, math.prod(scene.image_size), *surfaces)
        return hits


def settings_table(config: RenderConfig) -> np.ndarray:
    """Returns the rasteriser's settings as a table with one row, for kernels, without the field for the camera."""
    row = table = np.zeros(1, dtype=table_dtype(RayRasterData))
    for name in ("dilation", "sh_degree", "transmittance_min", "depth_iso_transmittance"):
        row[name] = getattr(config.raster, name)
    return table
