"""Derivatives of what rays of pixels show by Gaussians on CUDA. One block is one tile.

The equations are in docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.device.splat.compositor import WARP_OPTIONS, backward_arrays, backward_walk
from lumisplat.device.splat.ray_splat import ALONG_RAYS
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import PixelGradient, RaySplatGradient
from lumisplat.device.structs.raster import PixelRays, RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import RayData

wp.set_module_options(WARP_OPTIONS)

Arrays = backward_arrays(ALONG_RAYS)
add_records = backward_walk(ALONG_RAYS)


@wp.kernel(grid_stride=False)
def backward_ray_warps(
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[RaySplatGradient],
):
    """As ``backward_ray_tiles``. All threads of a block run through all batches, as they wait for each other."""
    tile, thread = wp.tid()
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_records(tile, thread, camera[0], settings[0], splats, tile_starts, tile_splats, around, arrays)
