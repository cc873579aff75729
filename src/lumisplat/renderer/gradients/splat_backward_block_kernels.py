"""Derivatives of composited pixels by splats on CUDA. One block is one tile, one thread one of its pixels.

The threads of a block walk the tile's splats together; what each adds to the record of a splat is summed over the
block, without atomics. The equations are in docs/method/gradients.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.gaussian.blend_gradient import (
    PairFloats,
    behind_pixel,
    pair_of_pixel,
    pair_slot,
    record_of,
)
from lumisplat.device.gaussian.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.gaussian.splat_coverage import log_alpha_at
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient, SplatGradient
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


@wp.kernel(grid_stride=False)
def backward_blocks(
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
    """As ``backward_tiles``. All threads of a block run through all splats, as they add up together."""
    tile, lane = wp.tid()
    view = camera[0]
    position = tile_pixel(view, tile * TILE_PIXELS + lane)
    x = position[0]
    y = position[1]
    t_min = settings[0].transmittance_min
    transmittance = float(-1.0)
    behind = float(0.0)
    mesh_z = float(0.0)
    by_color = wp.vec3(0.0)
    if x < view.width and y < view.height:
        pixel = y * view.width + x
        transmittance = 1.0
        mesh_z = meshes.depth_z[pixel]
        by_color = gradient.color[pixel]
        behind = behind_pixel(pixels, gradient, pixel, mesh_z)
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        splat = splats[index]
        part = PairFloats(0.0)
        log_alpha = log_alpha_at(splat, x, y)
        if transmittance > 0.0 and splat.depth < mesh_z and log_alpha >= LOG_ALPHA_MIN:
            alpha = alpha_from_log(log_alpha)
            weight = transmittance * alpha
            if transmittance - weight > t_min:
                shown = wp.dot(by_color, splat.color)
                part = pair_of_pixel(splat, x, y, alpha, transmittance, weight, shown, behind, by_color)
                behind -= weight * shown
                transmittance -= weight
            else:
                transmittance = -transmittance
        total = wp.tile_extract(wp.tile_sum(wp.tile(part, preserve_type=True)), 0)
        if lane == 0:
            slot = pair_slot(rects[index], pair_starts[index], tile % view.tiles_x, tile // view.tiles_x)
            pairs_out[slot] = record_of(splat, total)
