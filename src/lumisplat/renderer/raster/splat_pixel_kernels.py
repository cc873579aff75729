"""Compositing of ellipses, one item a pixel, tile after tile: samples on CUDA, and counts of blended splats on CPUs.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.camera.pixels import TILE_PIXELS, is_shown, picture_index, tile_pixel
from lumisplat.device.math.random import sample_key_of
from lumisplat.device.splat.blending import empty_pixel, opaque_pixel, store_gaussian_hits, store_result
from lumisplat.device.splat.compositor import pixel_walk
from lumisplat.device.splat.ellipse import ELLIPSE, look
from lumisplat.device.splat.visitors import ELLIPSE_COLOR, ELLIPSE_SAMPLE, NoArrays, Sample
from lumisplat.device.structs.camera import CameraData, PixelData, SampleData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

blend_ellipses = pixel_walk(ELLIPSE, ELLIPSE_COLOR)
sample_ellipses = pixel_walk(ELLIPSE, ELLIPSE_SAMPLE)


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
    raster = settings[0]
    at = tile_pixel(view, i)
    if not is_shown(view, at[0], at[1]):
        return
    pixel = empty_pixel()
    seen = look(view, meshes, at[0], at[1])
    blend_ellipses(i // TILE_PIXELS, seen, raster, splats, tile_starts, tile_splats, pixel, NoArrays())
    store_result(view, raster, instances, splats, meshes, pixel, at[0], at[1], for_rays, pixels_out, hits_out)


@wp.kernel
def sample_pixels(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
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
    at = tile_pixel(view, i)
    if not is_shown(view, at[0], at[1]):
        return
    seen = look(view, meshes, at[0], at[1])
    sample = Sample()
    sample.key = sample_key_of(picture_index(view, at[0], at[1]), samples[0].index, samples[0].seed)
    sample.nearest = seen.limit_z
    sample.winner = -1
    sample.transmittance = 1.0
    sample_ellipses(i // TILE_PIXELS, seen, settings[0], splats, tile_starts, tile_splats, sample, NoArrays())
    store_gaussian_hits(view, splats, opaque_pixel(splats, sample.winner), at[0], at[1], hits_out)
