"""Compositing of splats, one item a pixel, tile after tile: samples on CUDA, and counts of blended splats on CPUs.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.tiles import TILE_PIXELS, tile_pixel
from lumisplat.device.camera.window import image_index, is_shown, picture_index
from lumisplat.device.math.random import draw, sample_key_of
from lumisplat.device.splat.blending import blend, empty_pixel, opaque_pixel, store_gaussian_hits, store_result
from lumisplat.device.splat.ellipse import log_alpha_at
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})


@wp.kernel
def composite_pixels(
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
    """Item = tile * 256 + pixel of the tile. The result goes to the pixel or, ``for_rays``, to the hits of its ray."""
    i = start + wp.tid()
    view = camera[0]
    tile = i // TILE_PIXELS
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if not is_shown(view, x, y):
        return
    raster = settings[0]
    mesh_z = meshes.depth_z[image_index(view, x, y)]
    pixel = empty_pixel()
    j = int(tile_starts[tile])
    end = tile_starts[tile + 1]
    while j < end:
        index = tile_splats[j]
        splat = splats[index]
        if splat.depth >= mesh_z:
            break
        log_alpha = log_alpha_at(splat, x, y)
        if log_alpha >= LOG_ALPHA_MIN:
            pixel = blend(
                pixel, splat, index, alpha_from_log(log_alpha), raster.transmittance_min, raster.depth_iso_transmittance
            )
            if pixel.transmittance <= 0.0:
                break
        j += 1
    store_result(view, raster, instances, splats, meshes, pixel, x, y, for_rays, pixels_out, hits_out)


@wp.kernel
def sample_pixels(
    start: int,
    camera: wp.array[CameraData],
    samples: wp.array[SampleData],
    splats: wp.array[Splat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    meshes: MeshPixels,
    hits_out: GaussianHits,
):
    """Item = tile * 256 + pixel of the tile: the nearest splat that a random number below its alpha selects."""
    i = start + wp.tid()
    view = camera[0]
    sample = samples[0]
    tile = i // TILE_PIXELS
    position = tile_pixel(view, i)
    x = position[0]
    y = position[1]
    if not is_shown(view, x, y):
        return
    sample_key = sample_key_of(picture_index(view, x, y), sample.index, sample.seed)
    nearest = meshes.depth_z[image_index(view, x, y)]
    winner = int(-1)
    for j in range(tile_starts[tile], tile_starts[tile + 1]):
        index = tile_splats[j]
        splat = splats[index]
        if splat.depth < nearest or (splat.depth == nearest and index < winner):
            log_alpha = log_alpha_at(splat, x, y)
            if log_alpha >= LOG_ALPHA_MIN and draw(sample_key, wp.uint32(index)) < alpha_from_log(log_alpha):
                nearest = splat.depth
                winner = index
    store_gaussian_hits(view, splats, opaque_pixel(splats, winner), x, y, hits_out)
