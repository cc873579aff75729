"""Derivatives of what rays of pixels show by the Gaussians that they meet: from their sums to their places and shapes.

The equations are in docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.device.camera.camera import FISHEYE, turned
from lumisplat.device.camera.lens import view_at
from lumisplat.device.splat.ray_splat import DEPTH_MIN
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import RaySplatGradient
from lumisplat.device.structs.raster import WorldGaussian

wp.set_module_options({"enable_backward": False})


@wp.func
def pixel_variance_gradient(camera: CameraData, view: wp.vec3) -> wp.vec3:
    """Derivative of ``pixel_variance`` by the point of camera space."""
    per_pixel = 1.0 / (camera.focal[0] * camera.focal[1])
    z = view[2]
    distance2 = wp.max(wp.length_sq(view), DEPTH_MIN)
    distance = wp.sqrt(distance2)
    if camera.model == FISHEYE:
        across = wp.sqrt(view[0] * view[0] + view[1] * view[1])
        if across > 0.0:
            angle = wp.atan2(across, z)
            ratio = across / (distance * angle)
            by_across = distance / angle + ratio * (across - z / angle)
            by_z = ratio * (z + across / angle)
            return per_pixel * wp.vec3(by_across * view[0] / across, by_across * view[1] / across, by_z)
        return per_pixel * 2.0 * view
    depth = wp.max(z, 0.0)
    slope = per_pixel * depth * depth / distance
    return slope * (wp.vec3(0.0, 0.0, 3.0) - (depth / distance2) * view)


@wp.func
def scale_gradient(seen: WorldGaussian, sums: RaySplatGradient) -> wp.vec3:
    """By the standard deviations of the widened Gaussian, each over itself: half of it is by their squares."""
    return wp.cw_div(sums.squares, wp.cw_mul(seen.scale, seen.scale))


@wp.func
def turn_gradient(seen: WorldGaussian, sums: RaySplatGradient) -> wp.vec3:
    """By small turns about the Gaussian's own axes."""
    s = seen.scale
    return wp.vec3(
        sums.products[0] * (s[1] / s[2] - s[2] / s[1]),
        sums.products[1] * (s[2] / s[0] - s[0] / s[2]),
        sums.products[2] * (s[0] / s[1] - s[1] / s[0]),
    )


@wp.func
def mean_gradient(
    camera: CameraData, variance_per_pixel: float, seen: WorldGaussian, time: float, sums: RaySplatGradient
) -> wp.vec3:
    """By the mean, world space, by way of where it is and of how wide a pixel is there.

    Args:
        camera: The camera.
        variance_per_pixel: Variance by which it is widened, in squared widths of a pixel.
        seen: The Gaussian.
        time: Of the shutter, when its mean is seen.
        sums: Its derivatives.
    """
    by_mean = seen.axes * wp.cw_div(sums.point, seen.scale)
    if variance_per_pixel > 0.0:
        per_scale = scale_gradient(seen, sums)
        by_variance = 0.5 * variance_per_pixel * (per_scale[0] + per_scale[1] + per_scale[2])
        slope = camera.world_from_camera * pixel_variance_gradient(camera, view_at(camera, seen.point, time))
        if camera.shutter != 0:
            slope = turned(slope, camera.turn_axis, time * camera.turn_angle)
        by_mean += by_variance * slope
    return by_mean
