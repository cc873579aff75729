"""Nearest mesh surface at each pixel centre, on CUDA. One item is one pair of a tile and a triangle that may touch it.

Pairs write to the pixels that they share by an atomic minimum of depth and number together: whichever comes first, the
nearest triangle remains, and of equally near ones the first.
"""

import warp as wp

from lumisplat.device.camera.pixels import TILE, image_index, picture_index, tile_corner
from lumisplat.device.mesh.triangle_raster import depth_at, has_alpha, pixel_meets
from lumisplat.device.splat.blending import pixel_ray
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RasterMeshes, Triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOTHING = wp.constant(wp.int64(2**63 - 1))
"""Of a pixel without a triangle."""
INDEX_BITS = wp.constant(wp.int64(32))


@wp.func
def tile_of_pair(tile_starts: wp.array[int], pair: int) -> int:
    """The last tile whose list begins at or before a pair."""
    low = int(0)
    high = int(tile_starts.shape[0] - 1)
    while high - low > 1:
        middle = (low + high) // 2
        if tile_starts[middle] <= pair:
            low = middle
        else:
            high = middle
    return low


@wp.kernel
def clear_nearest(start: int, nearest_out: wp.array[wp.int64]):
    """Item = pixel: without a triangle yet."""
    nearest_out[start + wp.tid()] = NOTHING


@wp.kernel
def raster_pairs(
    start: int,
    camera: wp.array[CameraData],
    scene: RasterMeshes,
    triangles: wp.array[Triangle],
    tile_starts: wp.array[int],
    tile_triangles: wp.array[int],
    nearest_inout: wp.array[wp.int64],
):
    """Item = pair; those behind the last one are of nothing. The arithmetic of ``raster_tiles``."""
    pair = start + wp.tid()
    if pair >= tile_starts[tile_starts.shape[0] - 1]:
        return
    view = camera[0]
    corner = tile_corner(view, tile_of_pair(tile_starts, pair))
    index = tile_triangles[pair]
    triangle = triangles[index]
    is_whole = not has_alpha(triangle, scene)
    first = wp.max(int(triangle.row_first), corner[1])
    end = wp.min(wp.min(int(triangle.row_last) + 1, corner[1] + TILE), view.top + view.height)
    right = wp.min(corner[0] + TILE, view.left + view.width)
    for y in range(first, end):
        for x in range(corner[0], right):
            ray = pixel_ray(view, x, y)
            z = depth_at(triangle, ray)
            pixel = image_index(view, x, y)
            if z > view.near:
                key = (wp.int64(wp.cast(z, wp.int32)) << INDEX_BITS) | wp.int64(index)
                if key < nearest_inout[pixel] and (
                    is_whole or pixel_meets(triangle, ray, picture_index(view, x, y), scene)
                ):
                    wp.atomic_min(nearest_inout, pixel, key)


@wp.kernel
def store_nearest(start: int, nearest: wp.array[wp.int64], depth_out: wp.array[float], triangle_out: wp.array[int]):
    """Item = pixel: depth and number of its triangle."""
    pixel = start + wp.tid()
    key = nearest[pixel]
    if key == NOTHING:
        depth_out[pixel] = wp.inf
        triangle_out[pixel] = -1
    else:
        depth_out[pixel] = wp.cast(wp.int32(key >> INDEX_BITS), wp.float32)
        triangle_out[pixel] = wp.int32(key)
