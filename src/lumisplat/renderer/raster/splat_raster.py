"""Composites splats in front of meshes into pixels or ray hits (Kerbl et al. 2023, section 6)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import TILE_BANDS_PER_THREAD, TILE_PX
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits
from lumisplat.renderer.raster import (
    ellipsoid_kernels,
    relit_kernels,
    set_order_kernels,
    splat_kernels,
)
from lumisplat.renderer.raster.binning import Binning, DepthOrder
from lumisplat.renderer.raster.ellipsoids import Ellipsoids
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum
from lumisplat.runtime.struct_tables import table_dtype


@dataclass(frozen=True, slots=True)
class ProjectedSplats:
    """All Gaussians of a scene, projected to the image; arrays have one element for each Gaussian."""

    data: DeviceArray
    """``Splat`` (projected ellipse) of each Gaussian; undefined if the Gaussian is culled."""
    keys: DeviceArray
    """Depth key of each Gaussian, by which splats are sorted."""
    rects: DeviceArray
    """Rectangle of tiles that each splat may touch."""
    ellipsoids: DeviceArray
    """``SplatEllipsoid`` of each Gaussian, whose normals pixels blend; empty: pixels blend normals of splats."""

    @property
    def count(self) -> int:
        """Number of Gaussians, including culled ones."""
        return self.keys.shape[0]


@dataclass(frozen=True, slots=True)
class SplatTiles:
    """Splats listed for each tile, in blending order."""

    splats: DeviceArray
    """``Splat`` structs of all Gaussians of the scene."""
    starts: DeviceArray
    """Index in ``items`` of the first splat of each tile; the last element is the total number of entries."""
    items: DeviceArray
    """Indices in ``splats`` of the splats that each tile lists, tile after tile."""
    ellipsoids: DeviceArray
    """``SplatEllipsoid`` of each Gaussian of the scene; empty: pixels blend normals of splats."""


class SplatRaster:
    """Projects splats, lists them per tile and composites them.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
        binning: Sorts splats and lists them per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, binning: Binning) -> None:
        self._launcher, self._buffers, self._binning = launcher, buffers, binning
        self._ellipsoids = Ellipsoids(launcher, buffers, config)
        self.settings = buffers.upload("raster.settings", RasterData, raster_table(config))
        """``RasterData`` array with one element: the settings for kernels."""

    def modules(self, *, is_sorted: bool = True, counts: bool = False, merges_sets: bool = False) -> list[KernelModule]:
        """Returns the kernel modules for blending splats or, unless ``is_sorted``, for sampling them.

        ``counts`` is as for `find_hits`. ``merges_sets``: the scene has several splat sets (`FramePlan.merges_sets`).
        """
        by_pixel = splat_kernels.BLOCKS if is_sorted else splat_kernels.PIXELS
        by_tile = splat_kernels.TILES if is_sorted else splat_kernels.SAMPLE_TILES
        modules: list[KernelModule] = [by_pixel if self._launcher.is_parallel else by_tile]
        modules += [splat_kernels.PIXELS] if counts and not self._launcher.is_parallel else []
        modules += [set_order_kernels] if merges_sets else []
        if self._ellipsoids.are_used:
            modules += [ellipsoid_kernels]
            modules += [splat_kernels.ELLIPSOIDS] if is_sorted else []
            modules += [set_order_kernels.ELLIPSOIDS] if merges_sets else []
        return [*modules, splat_kernels, *self._binning.modules()]

    def project(self, scene: DeviceScene) -> ProjectedSplats:
        """Projects all Gaussians of the scene to ellipses in the image."""
        count = scene.gaussian_count
        splats = ProjectedSplats(
            self._buffers.get("raster.splats", Splat, count),
            keys=self._buffers.get("raster.keys", wp.uint32, count),
            rects=self._buffers.get("raster.rects", TileRect, count),
            ellipsoids=self._ellipsoids.none,
        )
        for asset in scene.assets:
            self._launcher.run_banded(
                splat_kernels.project_splats,
                asset.instanced_count,
                *(scene.splat_camera, self.settings, scene.splat_instances, asset.instance_ids, asset.data),
                *(splats.data, splats.keys, splats.rects),
            )
        return replace(splats, ellipsoids=self._ellipsoids.find(scene, splats.rects))

    def bin(self, scene: DeviceScene, order: DepthOrder, splats: ProjectedSplats) -> SplatTiles:
        """Lists the splats of each tile in the order of ``order``."""
        tiles_x, tiles_y = scene.tile_grid
        lists = self._binning.bin("raster", order, splats.rects, tiles_x, tiles_x * tiles_y)
        return SplatTiles(splats.data, lists.starts, lists.items, splats.ellipsoids)

    def draw(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        pixels: PixelData,
        *,
        finds_depth: bool,
    ) -> None:
        """Blends each pixel's splats front to back over the mesh or the background.

        The surface depth is that of the surface Gaussian: if ``finds_depth``, its peak on the pixel's ray, else its
        mean.
        """
        nothing = self._buffers.struct("raster.no_rays", GaussianHits, 0, EXTRA_FIELDS)
        arguments = (tiles.splats, tiles.starts, tiles.items, meshes, False, pixels, nothing)
        self._composite(scene, arguments, tiles.ellipsoids)
        if finds_depth:
            self._set_depth(scene, splat_kernels.set_pixel_depth, meshes, pixels)

    def find_hits(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        hits: GaussianHits,
        *,
        counts: bool,
    ) -> None:
        """Blends the splats in front of meshes into the Gaussian hits of the pixels' rays.

        If ``counts``, the number of blended splats is stored, too. Only the kernel with one thread per pixel counts
        splats. If ``counts``, it runs in addition to the kernel with one thread per tile.
        """
        arguments = (tiles.splats, tiles.starts, tiles.items, meshes, True, PixelData())
        self._composite(scene, (*arguments, hits), tiles.ellipsoids)
        if counts and not self._launcher.is_parallel and not self._ellipsoids.are_used:
            counted = self._buffers.struct("raster.counted", GaussianHits, len(hits.hits), EXTRA_FIELDS)
            self._composite(scene, (*arguments, counted), by_pixel=True)
            hits.hits = counted.hits
        self._set_depth(scene, splat_kernels.set_hit_depth, meshes, hits)

    def find_relit(self, scene: DeviceScene, tiles: SplatTiles, meshes: MeshPixels, hits: GaussianHits) -> None:
        """Adds to ``hits`` what relit splat sets contribute to each pixel.

        Tiles that also contain other sets are composited a second time, with all other sets black.
        """
        count, get = len(hits.hits), self._buffers.get
        relit = self._buffers.struct("raster.relit", GaussianHits, count, EXTRA_FIELDS)
        mixed = self._mixed_tiles(scene, tiles)
        self._composite(scene, (mixed.splats, mixed.starts, mixed.items, meshes, True, PixelData(), relit))
        hits.relit_color = get("raster.relit_color", wp.vec3, count)
        hits.relit_weight = get("raster.relit_weight", wp.float32, count)
        hits.relit_gaussian = get("raster.relit_gaussian", wp.int32, count)
        lists = (mixed.splats, tiles.starts, tiles.items, mixed.starts)
        self._run_pixels(
            scene,
            relit_kernels.find_relit,
            (scene.splat_camera, scene.splat_instances, *lists, meshes, relit, hits),
        )

    def _mixed_tiles(self, scene: DeviceScene, tiles: SplatTiles) -> SplatTiles:
        """Lists the splats of the tiles that contain both relit splat sets and others."""
        run, get, count = self._launcher.run_banded, self._buffers.get, math.prod(scene.tile_grid)
        counts, starts = (get(f"raster.mixed_{name}", wp.int32, count + 1) for name in ("counts", "starts"))
        items = get("raster.mixed_items", wp.int32, tiles.items.shape[0])
        splats = get("raster.mixed_splats", Splat, scene.gaussian_count)
        lists = (tiles.starts, tiles.items)
        run(relit_kernels.count_mixed, count, scene.splat_instances, *lists, counts)
        prefix_sum(counts, starts, inclusive=False)
        inputs = (scene.splat_instances, tiles.splats, *lists, starts)
        run(relit_kernels.list_mixed, count, *inputs, items, splats)
        return SplatTiles(splats, starts, items, self._ellipsoids.none)

    def find_means(
        self, scene: DeviceScene, splats: ProjectedSplats, tiles: SplatTiles, meshes: MeshPixels, hits: GaussianHits
    ) -> None:
        """Adds to ``hits`` the surface of relit splat sets, whose depth and material are weighted means over splats.

        Splats are composited again, with the values to average in place of colours and normals. The splats are
        overwritten, so this must run last.
        """
        count, run = len(hits.hits), self._launcher.run_banded
        inputs = (scene.splat_camera, self.settings, scene.shading, scene.gaussians, splats.rects, splats.data)
        run(relit_kernels.write_surface_attributes, splats.count, *inputs)
        sums = self._buffers.struct("raster.means", GaussianHits, count, EXTRA_FIELDS)
        self.sum_splats(scene, tiles, meshes, sums)
        hits.mean_depth = self._buffers.get("raster.mean_depth", wp.float32, count)
        hits.mean_finish = self._buffers.get("raster.mean_finish", wp.vec2, count)
        run(relit_kernels.store_means, math.prod(scene.image_size), scene.splat_camera, meshes, sums, hits)

    def sum_splats(self, scene: DeviceScene, tiles: SplatTiles, meshes: MeshPixels, sums: GaussianHits) -> None:
        """Sums colours and normals of splats in front of meshes, weighted as in blending, for each pixel's ray."""
        self._composite(scene, (tiles.splats, tiles.starts, tiles.items, meshes, True, PixelData(), sums))

    def sample_hits(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        hits: GaussianHits,
    ) -> None:
        """Chooses one splat per pixel with its blending weight as probability. Tile lists may be in any order."""
        lists = (tiles.splats, tiles.starts, tiles.items)
        inputs = (scene.splat_camera, self.settings, scene.sample, *lists, meshes, hits)
        if self._launcher.is_parallel:
            self._run_pixels(scene, splat_kernels.sample_pixels, inputs)
        else:
            self._run_tiles(scene, splat_kernels.sample_tiles, inputs)
        self._ellipsoids.set_normals(scene, tiles.ellipsoids, hits)
        self._set_depth(scene, splat_kernels.set_hit_depth, meshes, hits)

    def _set_depth(self, scene: DeviceScene, kernel: Kernel, meshes: MeshPixels, surfaces: object) -> None:
        """Moves surface depths from the means of Gaussians to their peak responses on the pixels' rays."""
        inputs = (scene.splat_camera, scene.splat_instances, scene.gaussians, meshes, surfaces)
        self._launcher.run_banded(kernel, math.prod(scene.image_size), *inputs)

    def _composite(
        self,
        scene: DeviceScene,
        arguments: tuple[object, ...],
        ellipsoids: DeviceArray | None = None,
        *,
        by_pixel: bool = False,
    ) -> None:
        """Blends splats by the kernel per pixel (``by_pixel``), per thread block (CUDA) or per tile.

        All kernels give the same result. Pixels where several sets overlap are then blended again. ``ellipsoids``: as
        in `SplatTiles`; only the kernel per pixel blends their normals. None: normals of splats are blended.
        """
        ellipsoids = self._ellipsoids.none if ellipsoids is None else ellipsoids
        inputs = (scene.splat_camera, self.settings, scene.splat_instances, *arguments)
        if len(ellipsoids):
            self._run_pixels(scene, splat_kernels.composite_ellipsoids, (*inputs, ellipsoids))
        elif by_pixel:
            self._run_pixels(scene, splat_kernels.composite_pixels, (*inputs, ellipsoids))
        elif self._launcher.is_parallel:
            self._launcher.run_blocks(splat_kernels.composite_blocks, math.prod(scene.tile_grid), *inputs)
        else:
            self._run_tiles(scene, splat_kernels.composite_tiles, inputs)
        if scene.plan.merges_sets:
            self._merge_sets(scene, arguments, ellipsoids)

    def _merge_sets(self, scene: DeviceScene, arguments: tuple[object, ...], ellipsoids: DeviceArray) -> None:
        """Blends pixels where captures overlap again, in the order of the captures' surfaces."""
        tiles, get = math.prod(scene.tile_grid), self._buffers.get
        splats, starts, items, *outputs = arguments
        split = get("raster.tile_streams", set_order_kernels.TileStreams, tiles)
        streams = get("raster.streams", set_order_kernels.StreamSplat, cast(DeviceArray, items).shape[0])
        view, instances = (scene.splat_camera, self.settings), scene.splat_instances
        lists = (splats, starts, items)
        bands = TILE_BANDS_PER_THREAD * self._launcher.threads
        inputs = (*view, instances, scene.gaussians, *lists, split, streams)
        self._launcher.run_banded(set_order_kernels.split_tiles, tiles, *inputs, bands=bands)
        inputs = (*view, instances, *lists, split, streams, *outputs, ellipsoids)
        pixels = tiles * TILE_PX * TILE_PX
        kernel = set_order_kernels.merge_ellipsoids if len(ellipsoids) else set_order_kernels.merge_sets
        self._launcher.run_banded(kernel, pixels, *inputs, bands=bands)

    def _run_pixels(self, scene: DeviceScene, kernel: Kernel, inputs: tuple[object, ...]) -> None:
        """Runs a kernel with one thread per pixel, tile after tile."""
        self._launcher.run_banded(kernel, math.prod(scene.tile_grid) * TILE_PX * TILE_PX, *inputs)

    def _run_tiles(self, scene: DeviceScene, kernel: Kernel, inputs: tuple[object, ...]) -> None:
        """Runs a kernel with one thread per tile."""
        bands = TILE_BANDS_PER_THREAD * self._launcher.threads
        self._launcher.run_banded(kernel, math.prod(scene.tile_grid), *inputs, bands=bands)


def raster_table(config: RenderConfig) -> np.ndarray:
    """Returns the rasteriser's settings as a table with one row, for kernels."""
    row = table = np.zeros(1, dtype=table_dtype(RasterData))
    row["dilation"] = config.raster.dilation
    row["sh_degree"] = config.raster.sh_degree
    row["transmittance_min"] = config.raster.transmittance_min
    row["depth_iso_transmittance"] = config.raster.depth_iso_transmittance
    row["background"] = config.background or (0.0, 0.0, 0.0)
    return table
