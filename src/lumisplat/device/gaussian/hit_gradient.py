"""Derivatives of a ray's hit by its Gaussian: of alpha by distance, of distance by mean, rotation and scales.

The equations are in docs/method/gradients.md#hits.
"""

import warp as wp

from lumisplat.device.bvh.nodes import footprint_of_ray, footprint_slopes, footprint_variance
from lumisplat.device.gaussian.ray_compositing import hit_color
from lumisplat.device.splat.projection import ALPHA_LIMIT, color_dot, open_channels, sh_weights
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import TraceData
from lumisplat.device.structs.gradients import GaussianGradient
from lumisplat.device.structs.rays import Ray
from lumisplat.device.structs.scene import GaussianData, KernelData, SplatInstanceData


@struct
class RayMotion:
    """By where the rays are that hit a Gaussian of an instance, object space."""

    shift: wp.vec3
    """By a shift of all of them."""
    turn: wp.vec3
    """By a turn of all of them about the origin."""


@struct
class HitMoments:
    """Sums over the hits of one Gaussian, of which its derivatives are made; along its own axes if not said otherwise.

    Beside the derivative by the squared canonical distance, the terms are those of docs/method/gradients.md#hits.
    """

    log_opacity: float
    pull: wp.vec3
    """Of the canonical offset of the ray from the mean, over the scales."""
    turn: wp.vec3
    """The torque of that about the mean."""
    spread: wp.vec3
    """Of the squares of that offset, over the scales."""
    path: wp.vec3
    """By the mean's place along the ray, which says how wide the ray is there; object space."""
    largest: float
    """By the largest scale, which does so, too; object space."""


NEAREST2 = wp.constant(wp.float32(1.0e-30))
"""Squared canonical distance below which a ray goes through the mean: degrees 0 and 1 have a kink there."""


@wp.func
def log_alpha_gradient(alpha: float, before: float, shown: float, behind: float) -> float:
    """Derivative by the logarithm of a hit's alpha; 0 where that is at its limit.

    ``before`` is the transmittance before the hit, ``shown`` the derivative by what the pixel shows times the hit's
    colour, and ``behind`` what of the loss is still to come, this hit included.
    """
    return wp.where(alpha < ALPHA_LIMIT, alpha * (before * shown - behind) / (1.0 - alpha), 0.0)


@wp.func
def log_response_slope(kernel: KernelData, distance2: float) -> float:
    """Derivative of the logarithm of a response by the squared canonical distance, within reach."""
    if kernel.degree == 2:
        return -0.5
    near2 = wp.max(distance2, NEAREST2)
    if kernel.degree == 0:
        distance = wp.sqrt(near2)
        return -0.5 * kernel.falloff / (distance * (1.0 - kernel.falloff * distance))
    half = 0.5 * float(kernel.degree)
    return -half * kernel.falloff * wp.pow(near2, half - 1.0)


@wp.func
def ray_in_object(instance: SplatInstanceData, ray: Ray) -> Ray:
    """The same ray with origin and direction in the space of an instance."""
    ray.origin = instance.object_from_world * ray.origin + instance.object_from_world_offset
    ray.direction = instance.object_from_world * ray.direction
    return ray


@wp.func
def add_hit(
    moments: HitMoments,
    instance: SplatInstanceData,
    mean: wp.vec3,
    axes: wp.mat33,
    scale: wp.vec3,
    ray: Ray,
    by_log_alpha: float,
) -> HitMoments:
    """Adds a hit to those of its Gaussian.

    ``axes`` of the Gaussian are columns, ``scale`` its standard deviations along them; the ray is in object space, and
    ``by_log_alpha`` the derivative by the logarithm of the hit's alpha.
    """
    away = ray.origin - mean
    footprint = footprint_of_ray(instance.footprint, ray.spread, instance.scale)
    path = ray.path_length - wp.dot(away, ray.direction) * instance.scale * instance.scale
    largest = instance.scale * wp.max(scale)
    variance = footprint_variance(footprint, path, largest)
    wide = wp.vec3(
        wp.sqrt(scale[0] * scale[0] + variance),
        wp.sqrt(scale[1] * scale[1] + variance),
        wp.sqrt(scale[2] * scale[2] + variance),
    )
    start = wp.cw_div(wp.transpose(axes) * away, wide)
    along = wp.normalize(wp.cw_div(wp.transpose(axes) * ray.direction, wide))
    across = wp.cross(along, wp.cross(start, along))  # start + t along would cancel for thin Gaussians
    by_distance2 = by_log_alpha * log_response_slope(instance.kernel, wp.dot(across, across))
    steep = wp.cw_div(across, wide)
    moments.log_opacity += by_log_alpha
    moments.pull += by_distance2 * steep
    moments.turn += by_distance2 * wp.cross(steep, wp.cw_mul(across, wide))
    moments.spread += by_distance2 * wp.cw_mul(wp.cw_mul(steep, steep), scale)
    if footprint > 0.0:
        by_variance = -by_distance2 * wp.dot(steep, steep)
        slopes = footprint_slopes(footprint, path, largest)
        moments.path += by_variance * slopes[0] * instance.scale * instance.scale * ray.direction
        moments.largest += by_variance * slopes[1] * instance.scale
    return moments


@wp.func
def add_moments(
    gaussians: GaussianData, i: int, axes: wp.mat33, moments: HitMoments, out: GaussianGradient
) -> RayMotion:
    """Adds the derivatives by Gaussian ``i`` that follow from its hits; returns those by its rays.

    These move against it: what changes if all of them are moved is what would if the Gaussian were moved back.
    """
    scale = gaussians.scales[i]
    by_scale = -2.0 * moments.spread
    longest = wp.max(scale)
    if scale[0] == longest:
        by_scale[0] = by_scale[0] + moments.largest
    elif scale[1] == longest:
        by_scale[1] = by_scale[1] + moments.largest
    else:
        by_scale[2] = by_scale[2] + moments.largest
    by_mean = moments.path - 2.0 * (axes * moments.pull)
    turn = 2.0 * moments.turn
    by_rotation = gaussians.rotations[i] * wp.quat(2.0 * turn[0], 2.0 * turn[1], 2.0 * turn[2], 0.0)
    out.means[i] = out.means[i] + by_mean
    out.rotations[i] = out.rotations[i] + by_rotation
    out.scales[i] = out.scales[i] + by_scale
    out.opacities[i] = out.opacities[i] + moments.log_opacity / gaussians.opacities[i]
    motion = RayMotion()
    motion.shift = -by_mean
    motion.turn = -(axes * turn) - wp.cross(gaussians.means[i], by_mean)
    return motion


@wp.func
def add_color(
    view: TraceData,
    instance: SplatInstanceData,
    gaussians: GaussianData,
    i: int,
    eye: wp.vec3,
    by_color: wp.vec3,
    motion: RayMotion,
    out: GaussianGradient,
) -> RayMotion:
    """Adds the derivatives by the harmonics and the mean of Gaussian ``i``, whose colour an eye sees.

    Returns ``motion`` with those by the rays: their eye moves with them.
    """
    if instance.shows_albedo != 0:
        return motion
    stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
    degree = wp.min(wp.min(view.sh_degree, instance.sh_degree), stored)
    first = i * gaussians.sh_count
    by_open = open_channels(hit_color(view, instance, gaussians, i, eye), by_color)
    weights = sh_weights(gaussians.sh, first, degree, by_open)
    by_mean, _eye, _degree, harmonics = wp.grad(color_dot)(gaussians.means[i], eye, degree, weights)
    for k in range((degree + 1) * (degree + 1)):
        out.sh[first + k] = out.sh[first + k] + harmonics[k] * by_open
    out.means[i] = out.means[i] + by_mean
    motion.shift -= by_mean
    motion.turn -= wp.cross(eye, by_mean)
    return motion
