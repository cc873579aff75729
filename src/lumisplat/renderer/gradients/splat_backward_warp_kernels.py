"""Derivatives of composited pixels by splats on CUDA. One block is one tile.

The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.device.splat.compositor import WARP_OPTIONS, backward_arrays, backward_walk
from lumisplat.device.splat.ellipse import ELLIPSE
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

wp.set_module_options(WARP_OPTIONS)

Arrays = backward_arrays(ELLIPSE)
add_records = backward_walk(ELLIPSE)


@wp.kernel(grid_stride=False)
def backward_warps(
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    splats: wp.array[Splat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[SplatGradient],
):
    """As ``backward_tiles``. All threads of a block run through all batches, as they wait for each other."""
    tile, thread = wp.tid()
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_records(tile, thread, camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)
