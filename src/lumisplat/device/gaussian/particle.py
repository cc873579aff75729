"""A Gaussian as rays hit it: its canonical space, its response by degree, and where it ends.

Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing, section 4.

The equations are in docs/method/gaussians.md.
"""

import warp as wp

from lumisplat.constants import BOX_MARGIN
from lumisplat.device.bvh.footprint import footprint_of_ray, footprint_variance
from lumisplat.device.math.aligned_memory import aligned_load_of
from lumisplat.device.math.sh import sh_color
from lumisplat.device.splat.projection import ALPHA_LIMIT, OPACITY_MIN, alpha_from_log, gaussian_normal
from lumisplat.device.structs.bvh import FAR, Box, Particle
from lumisplat.device.structs.rays import Ray
from lumisplat.device.structs.scene import GaussianData, KernelData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

load_particle = aligned_load_of(Particle)

MARGIN = wp.constant(wp.float32(BOX_MARGIN))
TINY = wp.constant(wp.float32(1.0e-30))


@wp.func
def distance_squared(kernel: KernelData, log_response: float) -> float:
    """Squared canonical distance at which a Gaussian's response has this logarithm, which is at most 0."""
    if kernel.degree == 0:
        distance = (1.0 - wp.exp(log_response)) / kernel.falloff
        return distance * distance
    exponent = -log_response / kernel.falloff
    if kernel.degree == 2:
        return exponent
    return wp.pow(exponent, 2.0 / float(kernel.degree))


@wp.func
def reach_squared(kernel: KernelData, opacity: float) -> float:
    """Squared canonical distance beyond which a Gaussian is ignored; negative: it is ignored everywhere.

    It ends where its alpha falls to 1/255, or its response to the minimum if that is nearer.
    """
    least = OPACITY_MIN / wp.max(opacity, TINY)
    if kernel.adaptive != 0:
        least = wp.max(least, kernel.min_response / wp.max(opacity, TINY))
    else:
        least = wp.max(least, kernel.min_response)
    if not least <= 1.0:
        return -1.0
    return distance_squared(kernel, wp.log(least))


@wp.func
def alpha_of_degree(kernel: KernelData, log_opacity: float, distance2: float) -> float:
    """Alpha at a squared canonical distance within reach."""
    if kernel.degree == 0:
        return wp.min(wp.exp(log_opacity) * wp.max(1.0 - kernel.falloff * wp.sqrt(distance2), 0.0), ALPHA_LIMIT)
    return alpha_from_log(log_opacity - kernel.falloff * wp.pow(distance2, 0.5 * float(kernel.degree)))


@wp.func
def canonical_from_object(rotation: wp.quat, scale: wp.vec3) -> wp.mat33:
    """Inverse of rotation times scale."""
    axes = wp.quat_to_matrix(rotation)
    return wp.matrix_from_rows(
        wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0]) / scale[0],
        wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1]) / scale[1],
        wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2]) / scale[2],
    )


@wp.func
def particle_of(kernel: KernelData, gaussians: GaussianData, i: int) -> Particle:
    """The record of Gaussian ``i`` in a BVH."""
    particle = Particle()
    particle.canonical_from_object = canonical_from_object(gaussians.rotations[i], gaussians.scales[i])
    particle.mean = gaussians.means[i]
    particle.log_opacity = wp.log(gaussians.opacities[i])
    particle.reach2 = reach_squared(kernel, gaussians.opacities[i])
    particle.index = i
    particle.largest_scale = wp.max(gaussians.scales[i])
    return particle


@wp.func
def particle_box(kernel: KernelData, gaussians: GaussianData, i: int) -> Box:
    """The tightest axis-aligned box of the ellipsoid at which Gaussian ``i`` ends; inverted if it is always ignored.

    Grown by a few units in the last place of its longest side, as rotation, box and ray are rounded.
    """
    box = Box()
    box.low = wp.vec3(FAR)
    box.high = wp.vec3(-FAR)
    reach2 = reach_squared(kernel, gaussians.opacities[i])
    if reach2 >= 0.0:
        spread = wp.quat_to_matrix(gaussians.rotations[i]) * wp.diag(gaussians.scales[i])
        mean = gaussians.means[i]
        reach = wp.vec3(wp.length(spread[0]), wp.length(spread[1]), wp.length(spread[2])) * wp.sqrt(reach2)
        half = wp.min(reach + (wp.vec3(wp.max(reach)) + wp.abs(mean)) * MARGIN, wp.vec3(FAR))
        box.low = mean - half
        box.high = mean + half
    return box


@wp.func
def ellipsoid_normal(
    instance: SplatInstanceData, gaussians: GaussianData, i: int, origin: wp.vec3, direction: wp.vec3, ray: Ray
) -> wp.vec3:
    """Unit normal, against the ray, where it enters the ellipsoid at which Gaussian ``i`` ends; object space.

    Args:
        instance: The placement of the set.
        gaussians: The set.
        i: The Gaussian.
        origin: Of the ray, object space.
        direction: Likewise.
        ray: The ray, world space.
    """
    scales = gaussians.scales[i]
    reach2 = reach_squared(instance.kernel, gaussians.opacities[i])
    path = ray.path_length + wp.dot(gaussians.means[i] - origin, direction) * instance.scale * instance.scale
    footprint = footprint_of_ray(instance.footprint, ray.spread, instance.scale)
    variance = footprint_variance(footprint, path, instance.scale * wp.max(scales))
    for k in range(3):
        scales[k] = wp.sqrt(scales[k] * scales[k] + variance)
    canonical = canonical_from_object(gaussians.rotations[i], scales)
    start = canonical * (origin - gaussians.means[i])
    along = wp.normalize(canonical * direction)
    across = start - wp.dot(start, along) * along
    depth2 = reach2 - wp.length_sq(across)
    entry = across - wp.sqrt(wp.max(depth2, 0.0)) * along
    smallest = wp.min(scales)
    normal = wp.normalize(wp.transpose(canonical * smallest) * entry)
    return wp.where(wp.dot(normal, direction) > 0.0, -normal, normal)


@wp.func
def gaussian_color(gaussians: GaussianData, i: int, eye: wp.vec3, sh_degree: int) -> wp.vec3:
    """Display-referred colour of Gaussian ``i`` from an eye in object space."""
    degree = wp.min(sh_degree, int(wp.sqrt(float(gaussians.sh_count))) - 1)
    return sh_color(gaussians.sh, i * gaussians.sh_count, degree, wp.normalize(gaussians.means[i] - eye))


@wp.func
def gaussian_facing(gaussians: GaussianData, i: int, eye: wp.vec3) -> wp.vec3:
    """Normal of the plane of largest density of Gaussian ``i`` from an eye in object space."""
    rotation = wp.quat_to_matrix(gaussians.rotations[i])
    return gaussian_normal(rotation, gaussians.scales[i], eye - gaussians.means[i])
