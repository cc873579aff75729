"""Host pass: the nearest mesh surface at each pixel."""

from __future__ import annotations

from typing import Any

import warp as wp

from lumisplat.constants import TILE_BANDS_PER_THREAD, TILE_PX
from lumisplat.device.structs.rays import RayData, RayMeshHits
from lumisplat.device.structs.scene import MeshHits, TileRect, Triangle
from lumisplat.renderer.raster import mesh_raster_kernels as kernels
from lumisplat.renderer.raster.binning import BinningChunked, BinningParallel
from lumisplat.renderer.scene.device_scene import DeviceScene, tile_grid
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera


class MeshRaster:
    """Rasterises triangles into ``MeshHits``.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        order: Lists triangles per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, order: BinningChunked | BinningParallel) -> None:
        self._launcher, self._buffers, self._order = launcher, buffers, order

    def draw(self, scene: DeviceScene, camera: Camera) -> MeshHits:
        """Depth, colour and normal of the meshes; depth is infinite where there is none."""
        hits, triangles, winners = self._find(scene, camera)
        if triangles is None:
            return hits
        pixels = camera.width * camera.height
        for name, dtype in (("color", wp.vec3), ("normal", wp.vec3), ("instance", wp.int32)):
            setattr(hits, name, self._buffers.get(f"mesh.{name}", dtype, pixels))
        self._launcher.run_banded(
            kernels.shade_hits,
            pixels,
            *(scene.camera, scene.mesh_instances, scene.instances.shape[0], scene.mesh_data, triangles, winners, hits),
        )
        return hits

    def meet(self, scene: DeviceScene, camera: Camera, rays: RayData) -> tuple[MeshHits, RayMeshHits]:
        """Depth of the meshes alone, and what of them the rays of the pixels meet, whose ``t_max`` moves there."""
        hits, triangles, winners = self._find(scene, camera)
        count = rays.t_max.shape[0]
        ray_hits = self._buffers.struct("mesh.ray_hits", RayMeshHits, count)
        if triangles is None:
            ray_hits.face.fill_(-1)
        else:
            self._launcher.run_banded(
                kernels.hits_of_rays,
                count,
                *(scene.camera, scene.instances.shape[0], triangles, winners, hits.depth_z, rays, ray_hits),
            )
        return hits, ray_hits

    def _find(self, scene: DeviceScene, camera: Camera) -> tuple[MeshHits, Any, Any]:
        """Depth, and the triangles of which one is nearest at each pixel; None where there are none."""
        pixels = camera.width * camera.height
        hits = MeshHits()
        hits.depth_z = self._buffers.get("mesh.depth", wp.float32, pixels)
        if not scene.triangle_count:
            hits.depth_z.fill_(float("inf"))
            for name, dtype in (("color", wp.vec3), ("normal", wp.vec3), ("instance", wp.int32)):
                setattr(hits, name, self._buffers.get(f"mesh.{name}", dtype, 1))
            return hits, None, None
        tiles_x, tiles_y = tile_grid(camera)
        triangles, rects = self._project(scene)
        everything = self._order.unsorted(triangles.shape[0])
        lists = self._order.bin("mesh", everything, rects, tiles_x, tiles_x * tiles_y)
        winners = self._buffers.get("mesh.triangle", wp.int32, pixels)
        per_tile = (scene.camera, triangles, lists.starts, lists.items, hits.depth_z, winners)
        if self._launcher.is_parallel:
            self._launcher.run(kernels.raster_pixels, tiles_x * tiles_y * TILE_PX * TILE_PX, 0, *per_tile)
        else:
            bands = TILE_BANDS_PER_THREAD * self._launcher.threads
            self._launcher.run_banded(kernels.raster_tiles, tiles_x * tiles_y, *per_tile, bands=bands)
        return hits, triangles, winners

    def _project(self, scene: DeviceScene) -> tuple[Any, Any]:
        triangles = self._buffers.get("mesh.triangles", Triangle, scene.triangle_count)
        rects = self._buffers.get("mesh.rects", TileRect, scene.triangle_count)
        self._launcher.run_banded(
            kernels.project_triangles,
            scene.triangle_count,
            *(scene.instances.shape[0], scene.camera, scene.mesh_instances, scene.mesh_data, triangles, rects),
        )
        return triangles, rects
