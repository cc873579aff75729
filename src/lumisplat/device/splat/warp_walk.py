"""Derivatives of composited pixels on CUDA. One block is one tile, and each of its warps has a square of it.

The threads of a block fetch a batch of the tile's splats together, and each warp walks it for its pixels. What they add
to the record of a splat is summed over the warp, without atomics and without barriers; after the batch, each thread
adds up what the warps have for one splat, and writes its record. The equations are in docs/method/gradients.md.
"""

from typing import Any

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
from lumisplat.device.splat.footprint import Footprint
from lumisplat.device.splat.projection import ALPHA_LIMIT, LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.splat.tile_visitors import backward_arrays
from lumisplat.device.structs.camera import CameraData

WARP_OPTIONS = {"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS, "block_dim": TILE_THREADS}
"""Of the modules that walk tiles by warps."""

wp.set_module_options(WARP_OPTIONS)


def backward_walk(footprint: Footprint) -> Any:
    """Returns the function that writes the records of a tile's splats, which all threads of a block call."""
    Settings, SplatType, Surroundings = footprint.settings, footprint.splat, footprint.surroundings
    Item, take, splat_of = footprint.item, footprint.take, footprint.splat_of
    look, covers, meet = footprint.look, footprint.covers, footprint.meet
    Sums, part_of, gradient_of, Gradient = footprint.sums, footprint.part_of, footprint.gradient_of, footprint.gradient
    Arrays = backward_arrays(footprint)
    add_up, sum_of = warp_sums(Sums, TILE_WARPS, TILE_THREADS)

    @wp.func
    def walk(
        tile: int,
        thread: int,
        view: CameraData,
        settings: Settings,
        splats: wp.array[SplatType],
        tile_starts: wp.array[int],
        tile_splats: wp.array[int],
        surroundings: Surroundings,
        arrays: Arrays,
    ):
        tile_x = tile % view.tiles_x
        tile_y = tile // view.tiles_x
        first = first_pixel(thread)
        x = tile_x * TILE + first[0]
        top = tile_y * TILE + first[1]
        t_min = settings.transmittance_min
        transmittance = RowFloats(-1.0)  # pixels outside the image count as finished
        limit_z = RowFloats(0.0)
        behind = RowFloats(0.0)
        red = RowFloats(0.0)
        green = RowFloats(0.0)
        blue = RowFloats(0.0)
        for k in range(ROWS):
            y = top + k * STRIDE
            if x < view.width and y < view.height:
                seen = look(view, surroundings, x, y)
                limit_z[k] = seen.limit_z
                if seen.limit_z > 0.0:
                    pixel = y * view.width + x
                    transmittance[k] = 1.0
                    red[k] = arrays.gradient.color[pixel][0]
                    green[k] = arrays.gradient.color[pixel][1]
                    blue[k] = arrays.gradient.color[pixel][2]
                    behind[k] = behind_pixel(arrays.pixels, arrays.gradient, pixel, seen.limit)

        batch = wp.tile_empty(shape=TILE_THREADS, dtype=Item, storage="shared")
        begin = int(tile_starts[tile])
        end = int(tile_starts[tile + 1])
        unfinished = int(1)
        while begin < end and unfinished > 0:
            count = wp.min(end - begin, THREADS)
            own = Item()
            if thread < count:
                take(splats, tile_splats[begin + thread], own)
            wp.tile_scatter_masked(batch, thread, own, thread < count)
            for j in range(count):
                splat = splat_of(splats, batch[j])
                part = Sums(0.0)
                has_part = bool(False)
                for k in range(ROWS):
                    seen = look(view, surroundings, x, top + k * STRIDE)
                    if transmittance[k] > 0.0 and splat.depth < limit_z[k] and covers(splat, seen):
                        at = meet(splat, seen)
                        if at.log_alpha >= LOG_ALPHA_MIN:
                            alpha = alpha_from_log(at.log_alpha)
                            weight = transmittance[k] * alpha
                            if transmittance[k] - weight > t_min:
                                has_part = True
                                by_color = wp.vec3(red[k], green[k], blue[k])
                                shown = wp.dot(by_color, splat.color)
                                v = alpha * (transmittance[k] * shown - behind[k]) / (1.0 - alpha)
                                at.alpha = alpha
                                part += part_of(splat, at, wp.where(alpha < ALPHA_LIMIT, v, 0.0), weight, by_color)
                                behind[k] = behind[k] - weight * shown
                                transmittance[k] = transmittance[k] - weight
                            else:
                                transmittance[k] = -transmittance[k]
                add_up(j, part, has_part)
            unfinished = wp.tile_sum(wp.tile(wp.where(wp.max(transmittance) > 0.0, 1, 0)))[0]
            if thread < count:
                rect = arrays.rects[own.index]
                record = gradient_of(splat_of(splats, own), sum_of(thread))
                arrays.pairs_out[pair_slot(rect, arrays.pair_starts[own.index], tile_x, tile_y)] = record
            begin += THREADS
        # What lies behind pixels that are all opaque has no part in them.
        for k in range(begin + thread, end, THREADS):
            index = tile_splats[k]
            slot = pair_slot(arrays.rects[index], arrays.pair_starts[index], tile_x, tile_y)
            arrays.pairs_out[slot] = Gradient()

    return walk
