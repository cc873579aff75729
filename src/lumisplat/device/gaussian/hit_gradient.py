"""Derivatives of ray hits: of alpha with respect to the distance, and of the distance with respect to the Gaussian.

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
    """Gradient of the loss with respect to moving all rays that hit a Gaussian as a rigid body, object space."""

    shift: wp.vec3
    """Gradient of the loss with respect to a common translation of the rays, object space."""
    rotation: wp.vec3
    """Gradient of the loss with respect to a common rotation of the rays about the object's origin, as a rotation
    vector."""


@struct
class HitMoments:
    """Sums over the hits of one Gaussian; the gradients of the Gaussian are computed from these sums.

    Each term is multiplied by g, the derivative of the loss with respect to the hit's squared canonical distance d^2.
    Vectors are along the Gaussian's axes unless stated otherwise. docs/method/gradients.md#hits defines the terms.
    """

    log_opacity: float
    pull: wp.vec3
    """Sum over hits of ``g c / s`` per axis, which gives the gradient of the mean.

    g is d loss / d d^2 of the hit, c the canonical vector from the mean to the ray, and s the widened standard
    deviation."""
    torque: wp.vec3
    """Sum over hits of ``g cross(c / s, c s)``, which gives the gradient of the rotation.

    g is d loss / d d^2 of the hit, c the canonical vector from the mean to the ray, and s the widened standard
    deviation."""
    spread: wp.vec3
    """Sum over hits of ``g (c / s)^2 scale`` per axis, which gives the gradient of the scales.

    g is d loss / d d^2 of the hit, c the canonical vector from the mean to the ray, and s the scale widened by the
    footprint."""
    path: wp.vec3
    """Gradient with respect to the mean, object space, through the footprint width: rays widen with the distance of
    the mean.
    """
    largest: float
    """Gradient with respect to the largest scale, object space, through the footprint width, which this scale limits.
    """


NEAREST2 = wp.constant(wp.float32(1.0e-30))
"""In derivatives of kernels of degree 0 and 1, squared canonical distances count as at least this: these kernels have
a kink at 0."""


@wp.func
def log_alpha_gradient(alpha: float, before: float, shown: float, behind: float) -> float:
    """Returns d loss / d log(alpha) of a hit: ``alpha (before * shown - behind) / (1 - alpha)``.

    It is 0 if alpha is clamped at its largest value. ``before`` is the transmittance in front of the hit. ``shown`` is
    the hit's colour times the pixel's colour gradient. ``behind`` is the sum of the loss terms of this hit and of
    everything behind it, as in ``RayGradient.behind``.
    """
    return wp.where(alpha < ALPHA_LIMIT, alpha * (before * shown - behind) / (1.0 - alpha), 0.0)


@wp.func
def log_response_slope(kernel: KernelData, distance2: float) -> float:
    """Returns d log(response) / d d^2, where d^2 is the squared canonical distance ``distance2``, within reach."""
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
    """Returns a ray with origin and direction transformed to the object space of a splat instance."""
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
    """Adds the terms of one hit to the gradient sums of its Gaussian.

    ``axes`` are the Gaussian's axes as columns, ``scale`` the standard deviations along them. The ray is in object
    space, and ``by_log_alpha`` is d loss / d log(alpha) of the hit.
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
    moments.torque += by_distance2 * wp.cross(steep, wp.cw_mul(across, wide))
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
    """Converts the hit sums of Gaussian ``i`` to gradients of mean, rotation, scales and opacity, added to ``out``.

    Returns the gradient with respect to a rigid motion of the rays. Moving the rays has the same effect as the opposite
    motion of the Gaussian.
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
    by_rotation_vector = 2.0 * moments.torque
    by_rotation = gaussians.rotations[i] * wp.quat(
        2.0 * by_rotation_vector[0], 2.0 * by_rotation_vector[1], 2.0 * by_rotation_vector[2], 0.0
    )
    out.means[i] = out.means[i] + by_mean
    out.rotations[i] = out.rotations[i] + by_rotation
    out.scales[i] = out.scales[i] + by_scale
    out.opacities[i] = out.opacities[i] + moments.log_opacity / gaussians.opacities[i]
    motion = RayMotion()
    motion.shift = -by_mean
    motion.rotation = -(axes * by_rotation_vector) - wp.cross(gaussians.means[i], by_mean)
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
    """Adds the gradients of SH and mean of Gaussian ``i``, by its view-dependent colour, to ``out``.

    ``by_color`` is d loss / d colour. Returns ``motion`` plus the gradient with respect to the eye, because the eye
    moves with the rays.
    """
    if instance.shows_albedo != 0:
        return motion
    stored = int(wp.sqrt(float(gaussians.sh_count))) - 1
    degree = wp.min(wp.min(view.sh_degree, instance.sh_degree), stored)
    first = i * gaussians.sh_count
    by_open = open_channels(hit_color(view, instance, gaussians, i, eye), by_color)
    weights = sh_weights(gaussians.sh, first, degree, by_open)
    by_mean, _eye, _degree, sh_basis = wp.grad(color_dot)(gaussians.means[i], eye, degree, weights)
    for k in range((degree + 1) * (degree + 1)):
        out.sh[first + k] = out.sh[first + k] + sh_basis[k] * by_open
    out.means[i] = out.means[i] + by_mean
    motion.shift -= by_mean
    motion.rotation -= wp.cross(eye, by_mean)
    return motion
