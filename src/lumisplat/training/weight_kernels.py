"""Finds the largest blending weight of each Gaussian by blending each tile front to back once more.

The pass runs once per training, so one implementation serves all devices.
"""

import warp as wp

from lumisplat.device.splat.compositor import TILE_OPTIONS, tile_walk
from lumisplat.device.splat.ellipse import ELLIPSE
from lumisplat.device.splat.ray_splat import ALONG_RAYS
from lumisplat.device.splat.visitors import WeightArrays, largest_weights
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import MeshPixels, PixelRays, RasterData, RayRasterData, RaySplat, Splat, TileRect
from lumisplat.device.structs.rays import RayData

wp.set_module_options(TILE_OPTIONS)

weigh_ellipses = tile_walk(ELLIPSE, largest_weights(ELLIPSE))
weigh_along_rays = tile_walk(ALONG_RAYS, largest_weights(ALONG_RAYS))


@wp.kernel
def find_largest_weights(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    pairs_out: wp.array[float],
):
    """Item = tile: writes the largest weight of each of its splats within the tile."""
    arrays = WeightArrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pairs_out = pairs_out
    weigh_ellipses(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


@wp.kernel
def find_largest_ray_weights(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pairs_out: wp.array[float],
):
    """Item = tile: writes the largest weight of each of its Gaussians within the tile, along rays."""
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    arrays = WeightArrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pairs_out = pairs_out
    weigh_along_rays(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, around, arrays)


@wp.kernel
def reduce_largest(start: int, pair_starts: wp.array[int], pairs: wp.array[float], largest_inout: wp.array[float]):
    """Item = Gaussian: updates its largest weight with those in its tiles."""
    i = start + wp.tid()
    largest = largest_inout[i]
    for k in range(pair_starts[i], pair_starts[i + 1]):
        largest = wp.max(largest, pairs[k])
    largest_inout[i] = largest
