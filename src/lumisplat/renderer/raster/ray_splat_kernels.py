"""Composites Gaussians along pixel rays: projects Gaussians to tiles, blends them, and finds their surface depth.

The CPU's and CUDA's schedules are separate Warp modules, as in ``splat_kernels``. The equations are in
docs/method/unscented.md.
"""

from typing import Any

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.camera.pixels import TILE_PIXELS, is_in_window, ray_index, ray_of_pixel, tile_pixel
from lumisplat.device.gaussian.particle import surface_peak
from lumisplat.device.splat.blending import begin_relit, empty_pixel, instance_of
from lumisplat.device.splat.compositor import TILE_OPTIONS, PixelVisitor, pixel_walk, tile_walk
from lumisplat.device.splat.ray_splat import ALONG_RAYS, is_finite, pixel_at, ray_splat, tiles_of
from lumisplat.device.splat.visitors import RAY_COLOR, RAY_COLORS, RAY_ELLIPSOIDS, RelitHits
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import PixelRays, RayRasterData, RaySplat, SplatEllipsoid, TileRect
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

OPTIONS = {"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS}
wp.set_module_options(OPTIONS)

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))

# Kernels that run before and after compositing.


@wp.kernel
def project_gaussians(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats_out: wp.array[RaySplat],
    keys_out: wp.array[wp.uint32],
    rects_out: wp.array[TileRect],
):
    """Projects a Gaussian to the image. One thread per Gaussian of one instance of an asset.

    The depth key of the Gaussian holds the bits of a positive float: as integers, such bits sort like the floats.
    """
    i = start + wp.tid()
    count = gaussians.means.shape[0]
    splat = ray_splat(camera[0], settings[0], instances[instance_ids[i // count]], gaussians, i % count)
    key = KEY_CULLED
    rect = TileRect()
    if splat.box.x0 < splat.box.x1:
        key = KEY_NONFINITE
        if is_finite(splat):
            key = wp.cast(splat.depth, wp.uint32)
            rect = tiles_of(camera[0], splat.box)
            splats_out[splat.index] = splat  # culled ones are never read
    keys_out[splat.index] = key
    rects_out[splat.index] = rect


@wp.kernel
def set_depth(
    start: int,
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    rays: RayData,
    limits: wp.array[float],
    hits_inout: GaussianHits,
):
    """Per pixel: sets the surface depth to the peak of its surface Gaussian, without dilation, on the pixel's ray."""
    width = camera[0].width
    pixel = start + wp.tid()
    i = ray_of_pixel(width, pixel % width, pixel // width)
    if hits_inout.depth[i] < wp.inf:
        index = hits_inout.gaussian[i]
        number = instance_of(instances, index)
        gaussian = index - instances[number].first
        asset = instances[number].asset
        scale = assets[asset].scales[gaussian]
        origin = instances[number].object_from_world * rays.origin[i] + instances[number].object_from_world_offset
        along = instances[number].object_from_world * rays.direction[i]
        away = assets[asset].means[gaussian] - origin
        size = instances[number].scale
        middle = wp.dot(away, along) * size * size
        depth = surface_peak(assets[asset].rotations[gaussian], scale, away, along, middle, size * wp.max(scale))
        hits_inout.depth[i] = wp.clamp(depth, rays.t_min[i], limits[i])


# CPUs: one item is one tile.

TILES = wp.get_module(f"{__name__}.tiles")
wp.set_module_options(TILE_OPTIONS, TILES)

blend_tile = tile_walk(ALONG_RAYS, RAY_COLORS)


@wp.kernel(module=TILES)
def composite_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    hits_out: GaussianHits,
):
    """Per tile: blends the Gaussians listed for it into the hits of its pixels' rays."""
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    blend_tile(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, around, hits_out)


# CUDA, and CPUs where Gaussians are counted, relit sets summed separately, or normals are those of ellipsoids: one item
# is one pixel.

PIXELS = wp.get_module(f"{__name__}.pixels")
wp.set_module_options(OPTIONS, PIXELS)


def pixel_kernel(module: wp.Module, visitor: PixelVisitor) -> Any:
    """Builds the kernel that blends Gaussians along the rays of pixels, as its namesake in ``splat_kernels``."""
    blend_pixel = pixel_walk(ALONG_RAYS, visitor)

    @wp.kernel(module=module)
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
        ellipsoids: wp.array[SplatEllipsoid],
    ):
        """Blends the Gaussians listed for a pixel's tile into the hit of the pixel's ray.

        One thread per pixel, with index tile * 256 + pixel of the tile. Surface depths are 0 until ``set_depth`` runs.
        """
        i = start + wp.tid()
        view = camera[0]
        at = tile_pixel(view, i)
        if not is_in_window(view, at[0], at[1]):
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
        seen = pixel_at(view, around, at[0], at[1])
        relit.ellipsoids = ellipsoids
        relit.moved = seen.time * seen.motion
        relit.direction = seen.direction
        if seen.limit_z == 0.0:
            pixel.transmittance = -1.0  # there is no ray
        blend_pixel(i // TILE_PIXELS, seen, settings[0], splats, tile_starts, tile_splats, pixel, relit)
        hits_out.color[relit.ray] = pixel.color
        hits_out.normal[relit.ray] = pixel.normal
        hits_out.transmittance[relit.ray] = wp.abs(pixel.transmittance)
        hits_out.depth[relit.ray] = wp.where(pixel.surface >= 0, 0.0, wp.inf)
        hits_out.gaussian[relit.ray] = wp.where(pixel.surface >= 0, pixel.surface, pixel.first)
        hits_out.hits[relit.ray] = pixel.hits

    return composite_pixels


composite_pixels = pixel_kernel(PIXELS, RAY_COLOR)

ELLIPSOIDS = wp.get_module(f"{__name__}.ellipsoids")
wp.set_module_options(OPTIONS, ELLIPSOIDS)

composite_ellipsoids = pixel_kernel(ELLIPSOIDS, RAY_ELLIPSOIDS)
