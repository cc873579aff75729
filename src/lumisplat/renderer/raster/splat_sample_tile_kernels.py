"""Samples of ellipses on CPUs. One item is one tile. Frames that blend need not compile it.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.device.splat.compositor import TILE_OPTIONS, tile_walk
from lumisplat.device.splat.ellipse import ELLIPSE
from lumisplat.device.splat.visitors import ELLIPSE_SAMPLES, SampleArrays
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits

wp.set_module_options(TILE_OPTIONS)

sample_ellipses = tile_walk(ELLIPSE, ELLIPSE_SAMPLES)


@wp.kernel
def sample_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    samples: wp.array[SampleData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    hits_out: GaussianHits,
):
    """Chooses, for each pixel, the nearest splat that a random number below its alpha selects."""
    arrays = SampleArrays()
    arrays.splats = splats
    arrays.sample = samples[0]
    arrays.hits_out = hits_out
    sample_ellipses(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)
