"""Finds the largest blending weight of each Gaussian in a frame, by compositing each tile without writing colours.

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
    """Writes the largest blending weight that each splat of a tile has in the tile's pixels. One thread per tile."""
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
    """Writes the largest blending weight of each splat of a tile on the tile's camera rays. One thread per tile."""
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
    """Raises a Gaussian's largest blending weight to that of the tiles which list it. One thread per Gaussian."""
    i = start + wp.tid()
    largest = largest_inout[i]
    for k in range(pair_starts[i], pair_starts[i + 1]):
        largest = wp.max(largest, pairs[k])
    largest_inout[i] = largest
