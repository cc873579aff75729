"""Composites projected ellipses: projects splats, blends or samples them per tile, and sets surface depths.

The CPU's and CUDA's schedules are separate Warp modules, because modules are compiled as a whole: a frame compiles only
the schedule that it runs. The equations are in docs/method/rasterisation.md.
"""

from typing import Any

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.camera.pixels import (
    TILE_PIXELS,
    full_image_index,
    full_pixel_of_index,
    image_index,
    is_in_window,
    ray_index,
    tile_pixel,
)
from lumisplat.device.gaussian.particle import surface_distance
from lumisplat.device.math.random import sample_key_of
from lumisplat.device.splat.blending import (
    blend_own,
    empty_pixel,
    instance_of,
    opaque_pixel,
    pixel_ray,
    store_gaussian_hits,
    store_result,
)
from lumisplat.device.splat.compositor import TILE_OPTIONS, PixelVisitor, pixel_walk, tile_walk
from lumisplat.device.splat.ellipse import (
    ELLIPSE,
    EllipsePixel,
    evaluate,
    is_finite,
    load_splat,
    pixel_at,
    store_splat,
    tile_range,
)
from lumisplat.device.splat.projection import LOG_ALPHA_MIN, alpha_from_log, project_gaussian
from lumisplat.device.splat.visitors import (
    ELLIPSE_COLOR,
    ELLIPSE_COLORS,
    ELLIPSE_ELLIPSOIDS,
    ELLIPSE_SAMPLE,
    ELLIPSE_SAMPLES,
    EllipseColors,
    NoArrays,
    Sample,
    SampleArrays,
    SplatInstances,
)
from lumisplat.device.structs.camera import CameraData, PixelData, SampleData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, SplatEllipsoid, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

OPTIONS = {"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS}
wp.set_module_options(OPTIONS)

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))

# Kernels that run before and after compositing.


@wp.kernel
def project_splats(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats_out: wp.array[Splat],
    keys_out: wp.array[wp.uint32],
    rects_out: wp.array[TileRect],
):
    """Projects a Gaussian to an ellipse in the image. One thread per Gaussian of one instance of an asset.

    The depth key of the Gaussian holds the bits of a positive float: as integers, such bits sort like the floats.
    """
    i = start + wp.tid()
    view = camera[0]
    count = gaussians.means.shape[0]
    splat = project_gaussian(view, settings[0], instances[instance_ids[i // count]], gaussians, i % count)
    key = KEY_CULLED
    rect = TileRect()
    if splat.log_opacity > -wp.inf:
        if is_finite(splat):
            rect = tile_range(view, splat)
            if rect.x0 < rect.x1:
                key = wp.cast(splat.depth, wp.uint32)
        else:
            key = KEY_NONFINITE
    if key < KEY_NONFINITE:
        store_splat(splats_out, splat.index, splat)  # culled ones are never read
    keys_out[splat.index] = key
    rects_out[splat.index] = rect


@wp.kernel
def set_pixel_depth(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    meshes: MeshPixels,
    pixels_inout: PixelData,
):
    """Per pixel: moves its surface depth from its surface Gaussian's mean to that Gaussian's peak on the ray."""
    i = start + wp.tid()
    gaussian = pixels_inout.gaussian[i]
    if gaussian >= 0:
        at = full_pixel_of_index(camera[0], i)
        ray = pixel_ray(camera[0], at[0], at[1])
        number = pixels_inout.instance[i]
        distance = pixels_inout.depth[i]
        mesh_z = meshes.depth_z[i]
        pixels_inout.depth[i] = surface_distance(camera, instances, assets, number, gaussian, ray, distance, mesh_z)


@wp.kernel
def set_hit_depth(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    meshes: MeshPixels,
    hits_inout: GaussianHits,
):
    """Per ray: moves its surface depth from the mean of its surface Gaussian to that Gaussian's peak on the ray."""
    i = start + wp.tid()
    at = full_pixel_of_index(camera[0], i)
    hit = ray_index(camera[0], at[0], at[1])
    if hits_inout.depth[hit] < wp.inf:
        ray = pixel_ray(camera[0], at[0], at[1])
        number = instance_of(instances, hits_inout.gaussian[hit])
        gaussian = hits_inout.gaussian[hit] - instances[number].first
        distance = hits_inout.depth[hit]
        mesh_z = meshes.depth_z[i]
        hits_inout.depth[hit] = surface_distance(camera, instances, assets, number, gaussian, ray, distance, mesh_z)


# CPUs: one item is one tile.

TILES = wp.get_module(f"{__name__}.tiles")
wp.set_module_options(TILE_OPTIONS, TILES)
SAMPLE_TILES = wp.get_module(f"{__name__}.sample_tiles")
wp.set_module_options(TILE_OPTIONS, SAMPLE_TILES)

blend_tile = tile_walk(ELLIPSE, ELLIPSE_COLORS)
sample_tile = tile_walk(ELLIPSE, ELLIPSE_SAMPLES)


@wp.kernel(module=TILES)
def composite_tiles(
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
    """Blends the splats listed for a tile into its pixels or, if ``for_rays``, into the hits of the pixels' rays."""
    arrays = EllipseColors()
    arrays.instances = instances
    arrays.splats = splats
    arrays.tile_starts = tile_starts
    arrays.tile_splats = tile_splats
    arrays.meshes = meshes
    arrays.for_rays = for_rays
    arrays.pixels_out = pixels_out
    arrays.hits_out = hits_out
    blend_tile(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


@wp.kernel(module=SAMPLE_TILES)
def sample_tiles(
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
    """Per tile: chooses one splat for each pixel, the nearest whose alpha exceeds the splat's random number there."""
    arrays = SampleArrays()
    arrays.splats = splats
    arrays.sample = samples[0]
    arrays.hits_out = hits_out
    sample_tile(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, meshes, arrays)


# Blending on CUDA: one thread block is one tile, one thread is one of its pixels.

BLOCKS = wp.get_module(f"{__name__}.blocks")
wp.set_module_options(OPTIONS, BLOCKS)


@wp.kernel(module=BLOCKS, launch_bounds=(256, 4), grid_stride=False)
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
    """Blends like ``composite_tiles``, one thread block per tile (CUDA).

    The threads of a block load a batch of the tile's splats into shared memory, one splat each. Each thread then blends
    the batch into its pixel, so that a splat is loaded once per tile instead of once per pixel
    (docs/adr/0025-shared-memory-compositing.md). All threads run through all batches, because they synchronise.
    """
    tile, lane = wp.tid()
    view = camera[0]
    raster = settings[0]
    position = tile_pixel(view, tile * TILE_PIXELS + lane)
    x = position[0]
    y = position[1]
    is_inside = is_in_window(view, x, y)
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
            log_alpha = evaluate(near, seen).log_alpha
            j += 1
            if log_alpha >= LOG_ALPHA_MIN:
                if near.depth < seen.limit_z:
                    pixel = blend_own(pixel, near, alpha_from_log(log_alpha), raster, instances)
                if pixel.transmittance <= 0.0 or near.depth >= seen.limit_z:
                    pixel.transmittance = -wp.abs(pixel.transmittance)
                    j = count
        first += TILE_PIXELS
        unfinished = wp.tile_sum(wp.tile(wp.where(pixel.transmittance > 0.0, 1, 0)))[0]
    if is_inside:
        store_result(view, raster, instances, splats, meshes, pixel, x, y, for_rays, pixels_out, hits_out)


# One thread per pixel, tile after tile: samples on CUDA, and counts of blended splats on CPUs.

PIXELS = wp.get_module(f"{__name__}.pixels")
wp.set_module_options(OPTIONS, PIXELS)

sample_pixel = pixel_walk(ELLIPSE, ELLIPSE_SAMPLE)


def pixel_kernel(module: wp.Module, visitor: PixelVisitor) -> Any:
    """Builds the kernel that blends splats pixel by pixel, in ``module``, with normals as ``visitor`` chooses them."""
    blend_pixel = pixel_walk(ELLIPSE, visitor)

    @wp.kernel(module=module)
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
        ellipsoids: wp.array[SplatEllipsoid],
    ):
        """Blends the splats of a pixel's tile into the pixel or, if ``for_rays``, into the hit of its ray.

        One thread per pixel, with index tile * 256 + pixel of the tile.
        """
        i = start + wp.tid()
        view = camera[0]
        raster = settings[0]
        at = tile_pixel(view, i)
        if not is_in_window(view, at[0], at[1]):
            return
        pixel = empty_pixel()
        seen = pixel_at(view, meshes, at[0], at[1])
        arrays = SplatInstances()
        arrays.instances = instances
        arrays.ellipsoids = ellipsoids
        arrays.direction = view.world_from_camera * pixel_ray(view, at[0], at[1])
        blend_pixel(i // TILE_PIXELS, seen, raster, splats, tile_starts, tile_splats, pixel, arrays)
        store_result(view, raster, instances, splats, meshes, pixel, at[0], at[1], for_rays, pixels_out, hits_out)

    return composite_pixels


composite_pixels = pixel_kernel(PIXELS, ELLIPSE_COLOR)


@wp.kernel(module=PIXELS)
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
    """Per pixel: chooses one splat of its tile, the nearest whose alpha exceeds the splat's random number there.

    The thread index is tile * 256 + pixel of the tile.
    """
    i = start + wp.tid()
    view = camera[0]
    at = tile_pixel(view, i)
    if not is_in_window(view, at[0], at[1]):
        return
    seen = pixel_at(view, meshes, at[0], at[1])
    sample = Sample()
    sample.key = sample_key_of(full_image_index(view, at[0], at[1]), samples[0].index, samples[0].seed)
    sample.nearest = seen.limit_z
    sample.winner = -1
    sample.transmittance = 1.0
    sample_pixel(i // TILE_PIXELS, seen, settings[0], splats, tile_starts, tile_splats, sample, NoArrays())
    store_gaussian_hits(view, splats, opaque_pixel(splats, sample.winner), at[0], at[1], hits_out)


# One thread per pixel, on all devices: blends normals of ellipsoids.

ELLIPSOIDS = wp.get_module(f"{__name__}.ellipsoids")
wp.set_module_options(OPTIONS, ELLIPSOIDS)

composite_ellipsoids = pixel_kernel(ELLIPSOIDS, ELLIPSE_ELLIPSOIDS)
