"""Finds the largest blending weight of each Gaussian, by blending each tile front to back without writing colours.

The kernels run once per training, so CPUs and CUDA share one implementation.
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
    """Writes the largest blending weight, within a tile, of each of the tile's splats. One item is one tile."""
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
    """Writes the largest blending weight along the rays of a tile, of each of its splats. One item is one tile."""
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
    """Raises the Gaussian's largest weight to the largest one in its tiles. One item is one Gaussian."""
    i = start + wp.tid()
    largest = largest_inout[i]
    for k in range(pair_starts[i], pair_starts[i + 1]):
        largest = wp.max(largest, pairs[k])
    largest_inout[i] = largest
