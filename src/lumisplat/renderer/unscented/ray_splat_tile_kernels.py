"""Compositing of Gaussians along the rays of pixels on CPUs. One item is one tile.

The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.device.splat.compositor import TILE_OPTIONS, tile_walk
from lumisplat.device.splat.ray_splat import ALONG_RAYS
from lumisplat.device.splat.visitors import RAY_COLORS
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import PixelRays, RayRasterData, RaySplat
from lumisplat.device.structs.rays import GaussianHits, RayData

wp.set_module_options(TILE_OPTIONS)

blend_along_rays = tile_walk(ALONG_RAYS, RAY_COLORS)


@wp.kernel
def composite_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    hits_out: GaussianHits,
):
    """Blends the Gaussians of a tile into the hits of its rays."""
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    blend_along_rays(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, around, hits_out)
