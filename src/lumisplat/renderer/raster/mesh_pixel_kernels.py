"""Nearest mesh surface at each pixel centre, on CUDA. One item is one pixel, tile after tile: one block is one tile."""

import warp as wp

from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.gaussian.compositing import pixel_ray
from lumisplat.device.mesh.raster_alpha import has_alpha, pixel_meets
from lumisplat.device.mesh.triangle_raster import depth_at
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterMeshes, Triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def raster_pixels(
    start: int,
    camera: wp.array[CameraData],
    scene: RasterMeshes,
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    depth_out: wp.array[float],
    triangle_out: wp.array[int],
):
    """Item = tile * 256 + pixel of the tile; the arithmetic of ``raster_tiles``."""
    i = start + wp.tid()
    view = camera[0]
    tile = i // TILE_PIXELS
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if x >= view.width or y >= view.height:
        return
    ray = pixel_ray(view, x, y)
    nearest = float(wp.inf)
    winner = int(-1)
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_triangles[j]
        # Most triangles of a dense mesh miss the two rows of a warp: then this is all that is read of them.
        if y < int(triangles[index].row_first) or y > int(triangles[index].row_last):
            continue
        triangle = triangles[index]
        z = depth_at(triangle, ray)
        if z > view.near and z < nearest:
            if not has_alpha(triangle, scene) or pixel_meets(triangle, ray, y * view.width + x, scene):
                nearest = z
                winner = index
    depth_out[y * view.width + x] = nearest
    triangle_out[y * view.width + x] = winner
