"""Compositing of Gaussians along the rays of pixels, one item a pixel, tile after tile: CUDA's schedule.

On CPUs it runs where blended Gaussians are counted, and where relit sets are added up apart.
The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.camera.window import is_shown, ray_index
from lumisplat.device.gaussian.ray_compositing import add_relit, begin_relit
from lumisplat.device.splat.blending import empty_pixel, lay_behind
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.splat.ray_splat import eye_of_row, is_within, log_alpha_along
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RayRasterData, RaySplat
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


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
    tile = i // TILE_PIXELS
    position = tile_pixel(camera[0], i)
    x = position[0]
    y = position[1]
    if not is_shown(camera[0], x, y):
        return
    ray = ray_index(camera[0], x, y)
    pixel = empty_pixel()
    begin_relit(hits_out, ray)
    j = int(tile_starts[tile])
    end = tile_starts[tile + 1]
    if not rays.is_active[ray]:
        j = end
    direction = rays.direction[ray]
    t_min = rays.t_min[ray]
    motion = camera[0].motion
    time = float(0.0)
    if camera[0].shutter != 0:
        time = (float(y) + 0.5) / float(camera[0].picture_height)
    while j < end:
        splat = splats[tile_splats[j]]
        j += 1
        if is_within(splat.box, x, y):
            eye = splat.eye
            if time > 0.0:
                eye = eye_of_row(splat, motion, time)
            log_alpha = log_alpha_along(splat, eye, direction, t_min, limits[ray])
            if log_alpha >= LOG_ALPHA_MIN:
                alpha = alpha_from_log(log_alpha)
                if not pixel.transmittance - pixel.transmittance * alpha > settings[0].transmittance_min:
                    break
                before = pixel
                iso = settings[0].depth_iso_transmittance
                pixel = lay_behind(pixel, splat.color, splat.normal, splat.index, alpha, iso)
                if hits_out.relit_weight:
                    add_relit(hits_out, ray, instances, before, pixel, splat.index)
    hits_out.color[ray] = pixel.color
    hits_out.normal[ray] = pixel.normal
    hits_out.transmittance[ray] = pixel.transmittance
    hits_out.depth[ray] = wp.where(pixel.surface >= 0, 0.0, wp.inf)
    hits_out.gaussian[ray] = wp.where(pixel.surface >= 0, pixel.surface, pixel.first)
    hits_out.hits[ray] = pixel.hits
