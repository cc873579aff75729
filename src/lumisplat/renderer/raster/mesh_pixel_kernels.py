"""Nearest mesh surface at each pixel centre, on CUDA. One item is one pixel, tile after tile: one block is one tile."""

import warp as wp

from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.gaussian.compositing import pixel_ray
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import Triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def raster_pixels(
    start: int,
    camera: wp.array[CameraData],
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
        triangle = triangles[index]
        e0 = triangle.edge0[0] * ray[0] + (triangle.edge0[1] * ray[1] + triangle.edge0[2])
        e1 = triangle.edge1[0] * ray[0] + (triangle.edge1[1] * ray[1] + triangle.edge1[2])
        e2 = triangle.edge2[0] * ray[0] + (triangle.edge2[1] * ray[1] + triangle.edge2[2])
        if wp.min(e0, wp.min(e1, e2)) >= 0.0 or wp.max(e0, wp.max(e1, e2)) <= 0.0:
            z = triangle.plane / (triangle.normal[0] * ray[0] + (triangle.normal[1] * ray[1] + triangle.normal[2]))
            if z > view.near and z < nearest:
                nearest = z
                winner = index
    depth_out[y * view.width + x] = nearest
    triangle_out[y * view.width + x] = winner
