"""Compositing of ellipses on CPUs. One item is one tile.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.device.splat.compositor import TILE_OPTIONS, tile_walk
from lumisplat.device.splat.ellipse import ELLIPSE
from lumisplat.device.splat.visitors import ELLIPSE_COLORS, EllipseColors
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options(TILE_OPTIONS)

blend_ellipses = tile_walk(ELLIPSE, ELLIPSE_COLORS)


@wp.kernel
def composite_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    for_rays: bool,
    pixels_out: PixelData,
    hits_out: GaussianHits,
):
    """Blends the splats of a tile; the result goes to its pixels or, ``for_rays``, to the hits of their rays."""
    arrays = EllipseColors()
    arrays.instances = instances
    arrays.splats = splats
    arrays.tile_starts = tile_starts
    arrays.tile_splats = tile_splats
    arrays.meshes = meshes
    arrays.for_rays = for_rays
    arrays.pixels_out = pixels_out
    arrays.hits_out = hits_out
    blend_ellipses(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)
