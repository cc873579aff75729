"""Kernels of the backward pass of ``Projection.UNSCENTED``, which rasterises 3D Gaussians along pixel rays.

The kernels for 2D ellipses are in ``splat_backward_kernels``. The equations are in
docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.device.camera.pixels import is_listed
from lumisplat.device.gaussian.hit_gradient import RayMotion
from lumisplat.device.splat.compositor import TILE_OPTIONS, WARP_OPTIONS, backward_arrays, backward_walk, tile_walk
from lumisplat.device.splat.projection import color_dot, open_channels, sh_weights
from lumisplat.device.splat.ray_splat import (
    ALONG_RAYS,
    exposure_time,
    eye_at,
    mean_gradient,
    rotation_gradient,
    scale_gradient,
    sum_of_records,
    widened_gaussian,
)
from lumisplat.device.splat.visitors import derivatives
from lumisplat.device.structs.camera import CameraData, PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient, RaySplatGradient
from lumisplat.device.structs.raster import PixelRays, RayRasterData, RaySplat, TileRect
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

wp.set_module_options(TILE_OPTIONS)

Arrays = backward_arrays(ALONG_RAYS)

# Gradient records on CPUs: one thread per tile.

TILES = wp.get_module(f"{__name__}.tiles")
wp.set_module_options(TILE_OPTIONS, TILES)

add_tile_records = tile_walk(ALONG_RAYS, derivatives(ALONG_RAYS))


@wp.kernel(module=TILES)
def backward_tiles(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[RaySplatGradient],
):
    """Per tile: blends its pixels once more, and writes a gradient record for each Gaussian listed for the tile."""
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_tile_records(start + wp.tid(), camera[0], settings[0], splats, tile_starts, tile_splats, around, arrays)


# Gradient records on CUDA: one thread block per tile.

BLOCKS = wp.get_module(f"{__name__}.blocks")
wp.set_module_options(WARP_OPTIONS, BLOCKS)

add_block_records = backward_walk(ALONG_RAYS)


@wp.kernel(module=BLOCKS, grid_stride=False)
def backward_blocks(
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    pair_starts: wp.array[int],
    tile_starts: wp.array[int],
    tile_splats: wp.array[int],
    rays: RayData,
    limits: wp.array[float],
    pixels: PixelData,
    gradient: PixelGradient,
    pairs_out: wp.array[RaySplatGradient],
):
    """Does the work of `backward_tiles` on CUDA, one thread block per tile.

    All threads of a block run all batches, because they synchronise.
    """
    tile, thread = wp.tid()
    around = PixelRays()
    around.rays = rays
    around.limits = limits
    arrays = Arrays()
    arrays.rects = rects
    arrays.pair_starts = pair_starts
    arrays.pixels = pixels
    arrays.gradient = gradient
    arrays.pairs_out = pairs_out
    add_block_records(tile, thread, camera[0], settings[0], splats, tile_starts, tile_splats, around, arrays)


# Gradients of Gaussians and of rays from the records.


@wp.kernel
def add_records(
    start: int,
    pair_starts: wp.array[int],
    pairs: wp.array[RaySplatGradient],
    splats_out: wp.array[RaySplatGradient],
):
    """Per Gaussian of the scene: sums its gradient records, one for each tile, in the order of the tiles."""
    i = start + wp.tid()
    splats_out[i] = sum_of_records(pairs, pair_starts[i], pair_starts[i + 1])


@wp.kernel
def backward_ray_gaussians(
    start: int,
    camera: wp.array[CameraData],
    settings: wp.array[RayRasterData],
    instances: wp.array[SplatInstanceData],
    instance_ids: wp.array[int],
    gaussians: GaussianData,
    splats: wp.array[RaySplat],
    rects: wp.array[TileRect],
    gradients: wp.array[RaySplatGradient],
    motions_out: wp.array[RayMotion],
    gaussians_out: GaussianGradient,
):
    """Per Gaussian of an asset: sums its gradients over all instances; writes each instance's ray motion gradient."""
    i = start + wp.tid()
    view = camera[0]
    raster = settings[0]
    by_mean = wp.vec3(0.0)
    by_rotation_vector = wp.vec3(0.0)
    by_scale = wp.vec3(0.0)
    by_opacity = float(0.0)
    first = i * gaussians.sh_count
    for k in range(gaussians.sh_count):
        gaussians_out.sh[first + k] = wp.vec3(0.0)
    for number in range(instance_ids.shape[0]):
        instance = instances[instance_ids[number]]
        index = instance.first + i
        motion = RayMotion()
        motions_out[index] = motion
        if not is_listed(rects[index]):
            continue
        sums = gradients[index]
        time = exposure_time(view, raster.field, instance, gaussians.means[i])
        gaussian = widened_gaussian(view, raster.dilation, instance, gaussians, i, time)
        widening = wp.where(instance.antialiased == 0, raster.dilation, 0.0)
        by_point = mean_gradient(view, widening, gaussian, time, sums)
        by_instance_mean = instance.scale * (wp.transpose(instance.world_from_object) * by_point)
        by_instance_rotation = rotation_gradient(gaussian, sums)
        by_mean += by_instance_mean
        by_rotation_vector += by_instance_rotation
        # Moving the rays is the same as moving the Gaussian back.
        motion.shift = -by_instance_mean
        motion.rotation = -wp.quat_rotate(gaussians.rotations[i], by_instance_rotation) - wp.cross(
            gaussians.means[i], by_instance_mean
        )
        world_scale = instance.scale * gaussians.scales[i]
        by_scale += instance.scale * wp.cw_mul(scale_gradient(gaussian, sums), world_scale)
        by_opacity += sums.log_opacity / gaussians.opacities[i]
        if instance.shows_albedo == 0:
            stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
            degree = wp.min(wp.min(raster.sh_degree, instance.sh_degree), stored)
            by_color = open_channels(splats[index].color, sums.color)
            weights = sh_weights(gaussians.sh, first, degree, by_color)
            eye = eye_at(view, instance, time)
            by_direction, _eye, _degree, sh_basis = wp.grad(color_dot)(gaussians.means[i], eye, degree, weights)
            for k in range((degree + 1) * (degree + 1)):
                gaussians_out.sh[first + k] = gaussians_out.sh[first + k] + sh_basis[k] * by_color
            by_mean += by_direction
            motion.shift -= by_direction
            motion.rotation -= wp.cross(eye, by_direction)
        motions_out[index] = motion
    gaussians_out.means[i] = by_mean
    gaussians_out.rotations[i] = gaussians.rotations[i] * wp.quat(
        2.0 * by_rotation_vector[0], 2.0 * by_rotation_vector[1], 2.0 * by_rotation_vector[2], 0.0
    )
    gaussians_out.scales[i] = by_scale
    gaussians_out.opacities[i] = by_opacity
