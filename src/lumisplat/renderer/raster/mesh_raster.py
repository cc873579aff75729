"""Finds the nearest mesh surface at each pixel by rasterisation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import warp as wp

from lumisplat.constants import TILE_BANDS_PER_THREAD
from lumisplat.device.structs.raster import MeshPixels, RasterMeshes, TileRect, Triangle
from lumisplat.device.structs.rays import MeshHits, RayData
from lumisplat.renderer.raster import mesh_kernels as kernels
from lumisplat.renderer.raster.binning import Binning
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher


@dataclass(frozen=True, slots=True)
class _NearestTriangles:
    """The nearest triangle at the centre of each pixel."""

    depth: DeviceArray
    """View depth of the triangle at each pixel; inf: no triangle."""
    triangles: DeviceArray | None = None
    """``Triangle`` structs of all mesh instances; None if the scene has no meshes."""
    winners: DeviceArray | None = None
    """Index in ``triangles`` of the nearest triangle at each pixel, -1: none; None if the scene has no meshes."""


class MeshRaster:
    """Rasterises triangles.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        binning: Lists triangles per tile.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, binning: Binning) -> None:
        self._launcher, self._buffers, self._binning = launcher, buffers, binning

    def modules(self, *, has_meshes: bool) -> list[KernelModule]:
        """Returns the kernel modules of scenes with or without meshes."""
        return [kernels.PAIRS if self._launcher.is_parallel else kernels.TILES, kernels] if has_meshes else []

    def draw(self, scene: DeviceScene) -> MeshPixels:
        """Rasterises the meshes, and returns their depth, colour and normal at each pixel."""
        nearest = self._find(scene)
        pixels = MeshPixels()
        pixels.depth_z = nearest.depth
        if nearest.triangles is None:
            return pixels
        count = math.prod(scene.image_size)
        for name, dtype in (("color", wp.vec3), ("normal", wp.vec3), ("instance", wp.int32)):
            setattr(pixels, name, self._buffers.get(f"mesh.{name}", dtype, count))
        instances = scene.mesh_instances, scene.splat_instances.shape[0]
        self._launcher.run_banded(
            kernels.shade_pixels,
            count,
            *(scene.camera, *instances, scene.mesh_data, nearest.triangles, nearest.winners, pixels),
        )
        return pixels

    def find_hits(self, scene: DeviceScene, rays: RayData) -> tuple[MeshPixels, MeshHits]:
        """Returns the depth of meshes at each pixel, without colours, and the hits of the pixels' rays on meshes."""
        nearest = self._find(scene)
        count = len(rays.t_max)
        pixels = MeshPixels()
        pixels.depth_z = nearest.depth
        hits = self._buffers.struct("raster.meshes", MeshHits, count)
        if nearest.triangles is None:
            device_array(hits.face).fill_(-1)
            hits.t = rays.t_max
        else:
            self._launcher.run_banded(
                kernels.find_ray_hits,
                count,
                *(scene.camera, scene.splat_instances.shape[0], nearest.triangles, nearest.winners),
                *(pixels.depth_z, rays, hits),
            )
        return pixels, hits

    def _find(self, scene: DeviceScene) -> _NearestTriangles:
        pixels = math.prod(scene.image_size)
        depth = self._buffers.get("mesh.depth", wp.float32, pixels)
        if not scene.triangle_count:
            depth.fill_(float("inf"))
            return _NearestTriangles(depth)
        tiles_x, tiles_y = scene.tile_grid
        triangles, rects = self._project(scene)
        everything = self._binning.unsorted(triangles.shape[0])
        lists = self._binning.bin("mesh", everything, rects, tiles_x, tiles_x * tiles_y)
        winners = self._buffers.get("mesh.triangle", wp.int32, pixels)
        per_tile = (scene.camera, raster_meshes(scene), triangles, lists.starts, lists.items)
        if self._launcher.is_parallel:
            run, nearest = self._launcher.run, self._buffers.get("mesh.nearest", wp.int64, pixels)
            run(kernels.clear_nearest, pixels, 0, nearest)
            run(kernels.raster_pairs, lists.items.shape[0], 0, *per_tile, nearest)
            run(kernels.store_nearest, pixels, 0, nearest, depth, winners)
        else:
            bands, tiles = TILE_BANDS_PER_THREAD * self._launcher.threads, tiles_x * tiles_y
            self._launcher.run_banded(kernels.raster_tiles, tiles, *per_tile, depth, winners, bands=bands)
        return _NearestTriangles(depth, triangles, winners)

    def _project(self, scene: DeviceScene) -> tuple[DeviceArray, DeviceArray]:
        """Returns the projected triangles of all mesh instances, and the rectangle of tiles that each may touch."""
        triangles = self._buffers.get("mesh.triangles", Triangle, scene.triangle_count)
        rects = self._buffers.get("mesh.rects", TileRect, scene.triangle_count)
        self._launcher.run_banded(
            kernels.project_triangles,
            scene.triangle_count,
            *(scene.splat_instances.shape[0], scene.camera, scene.mesh_instances, scene.mesh_data, triangles, rects),
        )
        return triangles, rects


def raster_meshes(scene: DeviceScene) -> RasterMeshes:
    """Returns the mesh instances, meshes and current sample in the struct from which raster kernels read alpha."""
    row = RasterMeshes()
    row.instances, row.splat_instance_count = scene.mesh_instances, scene.splat_instances.shape[0]
    row.meshes, row.sample = scene.mesh_data, scene.sample
    return row
