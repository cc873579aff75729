"""Compositing of Gaussians along the rays of pixels, one item a pixel, tile after tile: CUDA's schedule.

On CPUs it runs where blended Gaussians are counted, and where relit sets are added up apart.
The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.pixels import TILE_PIXELS, is_shown, ray_index, tile_pixel
from lumisplat.device.splat.blending import begin_relit, empty_pixel
from lumisplat.device.splat.compositor import pixel_walk
from lumisplat.device.splat.ray_splat import ALONG_RAYS, look
from lumisplat.device.splat.visitors import RAY_COLOR, RelitHits
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import PixelRays, RayRasterData, RaySplat
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

blend_along_rays = pixel_walk(ALONG_RAYS, RAY_COLOR)


@wp.kernel
def composite_pixels(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    instances: wp.array[SplatInstanceData],
    splats: wp.array[RaySplat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    hits_out: GaussianHits,
):
    """Item = tile * 256 + pixel of the tile; the depth of a surface is 0 until ``set_depth`` finds it."""
    i = start + wp.tid()
    view = camera[0]
    at = tile_pixel(view, i)
    if not is_shown(view, at[0], at[1]):
        return
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    relit = RelitHits()
    relit.instances = instances
    relit.hits = hits_out
    relit.ray = ray_index(view, at[0], at[1])
    begin_relit(hits_out, relit.ray)
    pixel = empty_pixel()
    seen = look(view, around, at[0], at[1])
    if seen.limit_z == 0.0:
        pixel.transmittance = -1.0  # there is no ray, and nothing on it
    blend_along_rays(i // TILE_PIXELS, seen, settings[0], splats, tile_starts, tile_splats, pixel, relit)
    hits_out.color[relit.ray] = pixel.color
    hits_out.normal[relit.ray] = pixel.normal
    hits_out.transmittance[relit.ray] = wp.abs(pixel.transmittance)
    hits_out.depth[relit.ray] = wp.where(pixel.surface >= 0, 0.0, wp.inf)
    hits_out.gaussian[relit.ray] = wp.where(pixel.surface >= 0, pixel.surface, pixel.first)
    hits_out.hits[relit.ray] = pixel.hits
