"""Derivatives of what rays of pixels show by Gaussians on CUDA. One block is one tile, a warp a square of it.

As ``splat_backward_warp_kernels`` do it for ellipses. The equations are in
docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.ray_blocks import ray_of_pixel
from lumisplat.device.camera.tiles import TILE, pair_slot
from lumisplat.device.camera.warp_tiles import (
    ROWS,
    STRIDE,
    THREADS,
    TILE_THREADS,
    TILE_WARPS,
    RowFloats,
    first_pixel,
)
from lumisplat.device.math.warp_sums import warp_sums
from lumisplat.device.splat.blending import behind_pixel
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.splat.ray_splat import eye_of_row, is_within, log_alpha_along
from lumisplat.device.splat.ray_splat_gradient import RaySplatFloats, nearest_point, record_of_pixel, record_of_sums
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient, RaySplatGradient
from lumisplat.device.structs.raster import RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS, "block_dim": TILE_THREADS})

add_up, sum_of = warp_sums(RaySplatFloats, TILE_WARPS, TILE_THREADS)


@wp.kernel(grid_stride=False)
def backward_ray_warps(
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[RaySplatGradient],
):
    """As ``backward_ray_tiles``. All threads of a block run through all batches, as they wait for each other."""
    tile, thread = wp.tid()
    width = camera[0].width
    height = camera[0].height
    tile_x = tile % camera[0].tiles_x
    tile_y = tile // camera[0].tiles_x
    motion = camera[0].motion
    has_shutter = camera[0].shutter != 0
    first = first_pixel(thread)
    x = tile_x * TILE + first[0]
    top = tile_y * TILE + first[1]
    t_floor = settings[0].transmittance_min
    transmittance = RowFloats(-1.0)  # pixels outside the image count as finished
    behind = RowFloats(0.0)
    for k in range(ROWS):
        y = top + k * STRIDE
        if x < width and y < height:
            ray = ray_of_pixel(width, x, y)
            if rays.is_active[ray]:
                transmittance[k] = 1.0
                behind[k] = behind_pixel(pixels, gradient, y * width + x, limits[ray])

    batch = wp.tile_empty(shape=TILE_THREADS, dtype=int, storage="shared")
    begin = int(tile_starts[tile])
    end = int(tile_starts[tile + 1])
    unfinished = int(1)
    while begin < end and unfinished > 0:
        count = wp.min(end - begin, THREADS)
        own = int(0)
        if thread < count:
            own = tile_splats[begin + thread]
        wp.tile_scatter_masked(batch, thread, own, thread < count)
        for j in range(count):
            splat = splats[batch[j]]
            part = RaySplatFloats(0.0)
            has_part = bool(False)
            for k in range(ROWS):
                y = top + k * STRIDE
                if transmittance[k] > 0.0 and is_within(splat.box, x, y):
                    ray = ray_of_pixel(width, x, y)
                    direction = rays.direction[ray]
                    eye = splat.eye
                    if has_shutter:
                        eye = eye_of_row(splat, motion, (float(y) + 0.5) / float(height))
                    log_alpha = log_alpha_along(splat, eye, direction, rays.t_min[ray], limits[ray])
                    if log_alpha >= LOG_ALPHA_MIN:
                        alpha = alpha_from_log(log_alpha)
                        weight = transmittance[k] * alpha
                        if transmittance[k] - weight > t_floor:
                            has_part = True
                            by_color = gradient.color[y * width + x]
                            shown = wp.dot(by_color, splat.color)
                            point = nearest_point(splat, eye, direction)
                            part += record_of_pixel(point, alpha, transmittance[k], weight, shown, behind[k], by_color)
                            behind[k] = behind[k] - weight * shown
                            transmittance[k] = transmittance[k] - weight
                        else:
                            transmittance[k] = -transmittance[k]
            add_up(j, part, has_part)
        unfinished = wp.tile_sum(wp.tile(wp.where(wp.max(transmittance) > 0.0, 1, 0)))[0]
        if thread < count:
            record = record_of_sums(sum_of(thread))
            pairs_out[pair_slot(rects[own], pair_starts[own], tile_x, tile_y)] = record
        begin += THREADS
    # What lies behind pixels that are all opaque has no part in them.
    for k in range(begin + thread, end, THREADS):
        index = tile_splats[k]
        pairs_out[pair_slot(rects[index], pair_starts[index], tile_x, tile_y)] = RaySplatGradient()
