"""Derivatives of composited pixels by splats on CUDA. One block is one tile, and each of its warps has a square of it.

The threads of a block fetch a batch of the tile's splats together, and each warp walks it for its pixels. What they add
to the record of a splat is summed over the warp, without atomics and without barriers; after the batch, each thread
adds up what the warps have for one splat, and writes its record. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
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
from lumisplat.device.splat.ellipse import PairFloats, load_splat, log_alpha_at, pair_of_pixel, record_of
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS, "block_dim": TILE_THREADS})

add_up, sum_of = warp_sums(PairFloats, TILE_WARPS, TILE_THREADS)


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
    view = camera[0]
    tile_x = tile % view.tiles_x
    tile_y = tile // view.tiles_x
    first = first_pixel(thread)
    x = tile_x * TILE + first[0]
    top = tile_y * TILE + first[1]
    t_min = settings[0].transmittance_min
    transmittance = RowFloats(-1.0)  # pixels outside the image count as finished
    behind = RowFloats(0.0)
    mesh_z = RowFloats(0.0)
    red = RowFloats(0.0)
    green = RowFloats(0.0)
    blue = RowFloats(0.0)
    for k in range(ROWS):
        y = top + k * STRIDE
        if x < view.width and y < view.height:
            pixel = y * view.width + x
            transmittance[k] = 1.0
            mesh_z[k] = meshes.depth_z[pixel]
            red[k] = gradient.color[pixel][0]
            green[k] = gradient.color[pixel][1]
            blue[k] = gradient.color[pixel][2]
            behind[k] = behind_pixel(pixels, gradient, pixel, mesh_z[k])

    batch = wp.tile_empty(shape=TILE_THREADS, dtype=Splat, storage="shared")
    begin = int(tile_starts[tile])
    end = int(tile_starts[tile + 1])
    unfinished = int(1)
    while begin < end and unfinished > 0:
        count = wp.min(end - begin, THREADS)
        own = Splat()
        if thread < count:
            load_splat(splats, tile_splats[begin + thread], own)
        wp.tile_scatter_masked(batch, thread, own, thread < count)
        for j in range(count):
            splat = batch[j]
            part = PairFloats(0.0)
            has_part = bool(False)
            for k in range(ROWS):
                y = top + k * STRIDE
                log_alpha = log_alpha_at(splat, x, y)
                if transmittance[k] > 0.0 and splat.depth < mesh_z[k] and log_alpha >= LOG_ALPHA_MIN:
                    alpha = alpha_from_log(log_alpha)
                    weight = transmittance[k] * alpha
                    if transmittance[k] - weight > t_min:
                        has_part = True
                        by_color = wp.vec3(red[k], green[k], blue[k])
                        shown = wp.dot(by_color, splat.color)
                        part += pair_of_pixel(splat, x, y, alpha, transmittance[k], weight, shown, behind[k], by_color)
                        behind[k] = behind[k] - weight * shown
                        transmittance[k] = transmittance[k] - weight
                    else:
                        transmittance[k] = -transmittance[k]
            add_up(j, part, has_part)
        unfinished = wp.tile_sum(wp.tile(wp.where(wp.max(transmittance) > 0.0, 1, 0)))[0]
        if thread < count:
            index = tile_splats[begin + thread]
            record = record_of(own, sum_of(thread))
            pairs_out[pair_slot(rects[index], pair_starts[index], tile_x, tile_y)] = record
        begin += THREADS
    # What lies behind pixels that are all opaque has no part in them.
    for k in range(begin + thread, end, THREADS):
        index = tile_splats[k]
        pairs_out[pair_slot(rects[index], pair_starts[index], tile_x, tile_y)] = SplatGradient()
