"""Gaussians before and after the rays of pixels meet them: their tiles, and the depth of each pixel's surface.

The equations are in docs/method/unscented.md.
"""

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.camera.pixels import ray_of_pixel
from lumisplat.device.gaussian.particle import surface_peak
from lumisplat.device.splat.blending import instance_of
from lumisplat.device.splat.ray_splat import is_finite, ray_splat, tiles_of
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.raster import RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))


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
    """Item = a Gaussian of an instance of one asset; the bits of a positive float sort as the float does."""
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
    """Item = pixel: where the Gaussian of its surface, whatever footprint widens it, responds most on its ray."""
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
