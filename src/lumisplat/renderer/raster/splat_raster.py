"""Host pass: splats, in front of meshes, into pixels or the hits of their rays (Kerbl et al. 2023, section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import TILE_BANDS_PER_THREAD, TILE_PX
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.renderer.raster import splat_raster_kernels as kernels
from lumisplat.renderer.raster.binning import Binning, DepthOrder
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype


@dataclass(frozen=True, slots=True)
class ProjectedSplats:
    """All Gaussians of a scene as an image sees them, one element each."""

    data: Any
    """``Splat``; undefined where it is culled."""
    keys: Any
    """By which they are sorted by depth."""
    rects: Any
    """Tiles that each may touch."""

    @property
    def count(self) -> int:
        """Gaussians, culled or not."""
        return self.keys.shape[0]


@dataclass(frozen=True, slots=True)
class SplatTiles:
    """The splats of each tile, in the order in which they are blended."""

    splats: Any
    """``Splat`` of all Gaussians of the scene."""
    starts: Any
    """First entry of each tile, and last the total."""
    items: Any
    """Numbers of splats, tile after tile."""


class SplatRaster:
    """Projects, bins and composites splats.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings; they do not change.
        binning: Sorts splats and lists them per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, binning: Binning) -> None:
        self._launcher, self._buffers, self._binning = launcher, buffers, binning
        self._settings = buffers.get("raster.settings", RasterData, 1)
        self._settings.assign(raster_table(config))

    def project(self, scene: DeviceScene) -> ProjectedSplats:
        """The splats of all Gaussians of the scene."""
        count = scene.gaussian_count
        splats = ProjectedSplats(
            self._buffers.get("raster.splats", Splat, count),
            keys=self._buffers.get("raster.keys", wp.uint32, count),
            rects=self._buffers.get("raster.rects", TileRect, count),
        )
        for asset in scene.assets:
            self._launcher.run_banded(
                kernels.project_splats,
                asset.placed_count,
                *(scene.camera, self._settings, scene.splat_instances, asset.instance_ids, asset.data),
                *(splats.data, splats.keys, splats.rects),
            )
        return splats

    def bin(self, scene: DeviceScene, order: DepthOrder, splats: ProjectedSplats) -> SplatTiles:
        """The splats of each tile, in that order."""
        tiles_x, tiles_y = scene.tile_grid
        lists = self._binning.bin("raster", order, splats.rects, tiles_x, tiles_x * tiles_y)
        return SplatTiles(splats.data, lists.starts, lists.items)

    def draw(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        pixels: PixelData,
    ) -> None:
        """Blends each pixel's splats front to back down to the mesh, and the mesh or background behind them."""
        nothing = self._buffers.struct("raster.no_rays", GaussianHits, 0)
        self._composite(scene, (tiles.splats, tiles.starts, tiles.items, meshes, False, pixels, nothing))

    def find_hits(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        hits: GaussianHits,
        *,
        counts: bool,
    ) -> None:
        """The same, but writes what the splats before the mesh give the rays of the pixels.

        Tiles do not count how many are blended: where it ``counts``, pixels are worked on one by one for that.
        """
        arguments = (tiles.splats, tiles.starts, tiles.items, meshes, True, PixelData())
        self._composite(scene, (*arguments, hits))
        if counts and not self._launcher.is_parallel:
            counted = self._buffers.struct("raster.counted", GaussianHits, hits.hits.shape[0])
            self._composite(scene, (*arguments, counted), by_pixel=True)
            hits.hits = counted.hits

    def sample_hits(
        self,
        scene: DeviceScene,
        tiles: SplatTiles,
        meshes: MeshPixels,
        hits: GaussianHits,
    ) -> None:
        """One splat a pixel, selected with its weight as probability; lists need no order."""
        inputs = (scene.camera, scene.sample, tiles.splats, tiles.starts, tiles.items, meshes, hits)
        self._run_tiles(scene, kernels.sample_tiles, kernels.sample_pixels, inputs)

    def _composite(self, scene: DeviceScene, arguments: tuple[Any, ...], *, by_pixel: bool = False) -> None:
        inputs = (scene.camera, self._settings, scene.splat_instances, *arguments)
        self._run_tiles(scene, kernels.composite_tiles, kernels.composite_pixels, inputs, by_pixel=by_pixel)

    def _run_tiles(
        self, scene: DeviceScene, tiles: Any, pixels: Any, inputs: tuple[Any, ...], *, by_pixel: bool = False
    ) -> None:
        """Runs the kernel of ``tiles``, or that of ``pixels``, which does the same: one block of pixels is a tile."""
        tiles_x, tiles_y = scene.tile_grid
        if self._launcher.is_parallel or by_pixel:
            self._launcher.run_banded(pixels, tiles_x * tiles_y * TILE_PX * TILE_PX, *inputs)
        else:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(tiles, tiles_x * tiles_y, *inputs, bands=bands)


def raster_table(config: RenderConfig) -> np.ndarray:
    """The 1-element table that kernels read the rasteriser's settings from."""
    row = table = np.zeros(1, dtype=table_dtype(RasterData))
    row["dilation"] = config.raster.dilation
    row["sh_degree"] = config.raster.sh_degree
    row["transmittance_min"] = config.raster.transmittance_min
    row["depth_iso_transmittance"] = config.raster.depth_iso_transmittance
    row["background"] = config.background or (0.0, 0.0, 0.0)
    return table
