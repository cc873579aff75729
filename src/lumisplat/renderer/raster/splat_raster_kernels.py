"""Splats before and after they are composited: their projection, and the depth of the surface in each pixel.

The equations are in docs/method/rasterisation.md.
"""

import warp as wp

from lumisplat.constants import DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.camera.pixels import ray_index, shown_pixel
from lumisplat.device.gaussian.particle import surface_distance
from lumisplat.device.splat.blending import instance_of, pixel_ray
from lumisplat.device.splat.ellipse import is_finite, store_splat, tile_range
from lumisplat.device.splat.projection import project_gaussian
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.raster import MeshPixels, RasterData, Splat, TileRect
from lumisplat.device.structs.rays import GaussianHits
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))


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
    """Item = a Gaussian of an instance of one asset; the bits of a positive float sort as the float does."""
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
    """Item = pixel: moves the surface of its Gaussians from the mean of the picked one to the peak on the ray."""
    i = start + wp.tid()
    gaussian = pixels_inout.gaussian[i]
    if gaussian >= 0:
        at = shown_pixel(camera[0], i)
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
    """``set_pixel_depth`` for the hits of the pixels' rays."""
    i = start + wp.tid()
    at = shown_pixel(camera[0], i)
    hit = ray_index(camera[0], at[0], at[1])
    if hits_inout.depth[hit] < wp.inf:
        ray = pixel_ray(camera[0], at[0], at[1])
        number = instance_of(instances, hits_inout.gaussian[hit])
        gaussian = hits_inout.gaussian[hit] - instances[number].first
        distance = hits_inout.depth[hit]
        mesh_z = meshes.depth_z[i]
        hits_inout.depth[hit] = surface_distance(camera, instances, assets, number, gaussian, ray, distance, mesh_z)
