"""Compositing of splats on CUDA. One block is one tile, one thread one of its pixels.

The threads of a block fetch a batch of the tile's splats together, one each, into memory that they share, and then each
walks the batch for its pixel: a splat is fetched once a tile instead of once a pixel. The equations are in
docs/method/rasterisation.md, the choice in docs/adr/0025-compositing-on-shared-tiles.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.pixels import TILE_PIXELS, image_index, is_shown, tile_pixel
from lumisplat.device.splat.blending import blend, empty_pixel, store_result
from lumisplat.device.splat.ellipse import EllipsePixel, load_splat, meet
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


@wp.kernel(launch_bounds=(256, 4), grid_stride=False)
def composite_blocks(
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
    """As ``composite_pixels``. All threads of a block run through all batches, as they wait for each other."""
    tile, lane = wp.tid()
    view = camera[0]
    raster = settings[0]
    position = tile_pixel(view, tile * TILE_PIXELS + lane)
    x = position[0]
    y = position[1]
    is_inside = is_shown(view, x, y)
    pixel = empty_pixel()
    seen = EllipsePixel()
    seen.center = wp.vec2(float(x) + 0.5, float(y) + 0.5)
    if is_inside:
        seen.limit_z = meshes.depth_z[image_index(view, x, y)]
    else:
        pixel.transmittance = -1.0
    batch = wp.tile_empty(shape=256, dtype=Splat, storage="shared")
    first = int(tile_starts[tile])
    end = int(tile_starts[tile + 1])
    unfinished = int(1)
    while first < end and unfinished > 0:
        splat = Splat()
        if first + lane < end:
            load_splat(splats, tile_splats[first + lane], splat)
        wp.tile_scatter_masked(batch, lane, splat, first + lane < end)
        count = wp.min(end - first, TILE_PIXELS)
        j = wp.where(pixel.transmittance > 0.0, 0, count)
        while j < count:
            near = batch[j]
            log_alpha = meet(near, seen).log_alpha
            j += 1
            if log_alpha >= LOG_ALPHA_MIN:
                if near.depth < seen.limit_z:
                    alpha = alpha_from_log(log_alpha)
                    pixel = blend(pixel, near, alpha, raster.transmittance_min, raster.depth_iso_transmittance)
                if pixel.transmittance <= 0.0 or near.depth >= seen.limit_z:
                    pixel.transmittance = -wp.abs(pixel.transmittance)
                    j = count
        first += TILE_PIXELS
        unfinished = wp.tile_sum(wp.tile(wp.where(pixel.transmittance > 0.0, 1, 0)))[0]
    if is_inside:
        store_result(view, raster, instances, splats, meshes, pixel, x, y, for_rays, pixels_out, hits_out)
