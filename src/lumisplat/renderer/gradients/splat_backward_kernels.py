"""Derivatives of composited pixels by splats on CPUs: each pixel is blended once more, front to back.

What is still to come behind a splat is one number a pixel. No splat is written to by two tiles: each has a record for
each of its tiles, and they are added up afterwards. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.device.camera.pixels import rect_area
from lumisplat.device.splat.compositor import TILE_OPTIONS, backward_arrays, tile_walk
from lumisplat.device.splat.ellipse import ELLIPSE, sum_of_pairs
from lumisplat.device.splat.visitors import derivatives
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

wp.set_module_options(TILE_OPTIONS)

Arrays = backward_arrays(ELLIPSE)
add_records = tile_walk(ELLIPSE, derivatives(ELLIPSE))


@wp.kernel
def count_pairs(start: int, rects: wp.array[TileRect], counts_out: wp.array[int]):
    """Tiles of each splat; one more element than splats, so that their sums end on the total."""
    i = start + wp.tid()
    counts_out[i] = 0
    if i < rects.shape[0]:
        counts_out[i] = rect_area(rects[i])


@wp.kernel
def backward_tiles(
    start: int,
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
    """Item = tile: a record for each of its splats."""
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_records(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


@wp.kernel
def add_pairs(
    start: int, pair_starts: wp.array[int], pairs: wp.array[SplatGradient], splats_out: wp.array[SplatGradient]
):
    """Item = splat: the sum of its records, in the order of its tiles."""
    i = start + wp.tid()
    splats_out[i] = sum_of_pairs(pairs, pair_starts[i], pair_starts[i + 1])
