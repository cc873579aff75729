"""Derivatives of what rays of pixels show by the Gaussians that they meet: the parts that all schedules share.

The equations are in docs/method/gradients.md#rasterisation-along-rays.
"""

import warp as wp

from lumisplat.device.camera.camera import FISHEYE, turned
from lumisplat.device.camera.lens import view_at
from lumisplat.device.splat.projection import ALPHA_LIMIT
from lumisplat.device.splat.ray_splat import DEPTH_MIN
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.gradients import RaySplatGradient
from lumisplat.device.structs.raster import RaySplat, WorldGaussian

wp.set_module_options({"enable_backward": False})

RaySplatFloats = wp.types.vector(length=14, dtype=wp.float32)
"""Sums over pixels, of which a record is made, in the order of its fields."""


@wp.func
def nearest_point(splat: RaySplat, eye: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """The point of a ray at which a splat responds most, canonical space; arguments as of ``log_alpha_along``."""
    along = splat.canonical_from_world * direction
    return wp.cross(along, wp.cross(eye, along)) / wp.length_sq(along)


@wp.func
def record_of_pixel(
    point: wp.vec3, alpha: float, transmittance: float, weight: float, shown: float, behind: float, by_color: wp.vec3
) -> RaySplatFloats:
    """What one pixel adds, in which a splat is blended, whose ray is nearest to it at a canonical point."""
    v = wp.where(alpha < ALPHA_LIMIT, alpha * (transmittance * shown - behind) / (1.0 - alpha), 0.0)
    return RaySplatFloats(
        weight * by_color[0],
        weight * by_color[1],
        weight * by_color[2],
        v,
        weight,
        v * point[0],
        v * point[1],
        v * point[2],
        v * point[0] * point[0],
        v * point[1] * point[1],
        v * point[2] * point[2],
        v * point[1] * point[2],
        v * point[2] * point[0],
        v * point[0] * point[1],
    )


@wp.func
def record_of_sums(sums: RaySplatFloats) -> RaySplatGradient:
    """The record of a splat, of its sums over pixels."""
    record = RaySplatGradient()
    record.color = wp.vec3(sums[0], sums[1], sums[2])
    record.log_opacity = sums[3]
    record.weight = sums[4]
    record.point = wp.vec3(sums[5], sums[6], sums[7])
    record.squares = wp.vec3(sums[8], sums[9], sums[10])
    record.products = wp.vec3(sums[11], sums[12], sums[13])
    return record


@wp.func
def sum_of_records(records: wp.array[RaySplatGradient], begin: int, end: int) -> RaySplatGradient:
    """The sum of the records of a splat."""
    total = RaySplatGradient()
    for k in range(begin, end):
        part = records[k]
        total.color += part.color
        total.log_opacity += part.log_opacity
        total.weight += part.weight
        total.point += part.point
        total.squares += part.squares
        total.products += part.products
    return total


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
