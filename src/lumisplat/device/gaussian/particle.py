"""Gaussians as rays hit them: canonical space, response by degree, extent, and intersection of single rays.

Source: Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing, section 4. The equations are in docs/method/gaussians.md.
"""

import warp as wp

from lumisplat.constants import BOX_MARGIN
from lumisplat.device.bvh.nodes import footprint_of_ray, footprint_variance, larger, lesser, tree_ray
from lumisplat.device.math.memory import aligned_load_of
from lumisplat.device.math.sh import sh_color
from lumisplat.device.splat.projection import ALPHA_LIMIT, OPACITY_MIN, alpha_from_log, entry_normal, gaussian_normal
from lumisplat.device.structs import struct
from lumisplat.device.structs.bvh import FAR, HIT_HULL, HIT_MEAN, HIT_PEAK, Box, Particle, TreeRay
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.rays import Ray, RayData
from lumisplat.device.structs.scene import GaussianData, KernelData, SplatInstanceData


@struct
class ParticleHit:
    """Intersection of a single ray with a Gaussian: distance, canonical distance, and whether it is near the origin."""

    t: float
    """Distance along the ray by which hits are sorted; FAR: the ray misses the Gaussian."""
    distance2: float
    """Squared distance, in standard deviations, from the mean to the nearest point of the ray, where the response
    peaks."""
    is_near: bool
    """True: the hit is so close to the ray's origin that it counts only if the Gaussian is of another surface layer."""


SURFACE_DEPTH_SCALES = 3.0
"""The surface of a Gaussian lies at most this many of its largest scales before or behind its mean on a ray.

Only Gaussians smaller than a pixel reach this limit, because the pixel's footprint shows them beyond their extent."""

load_particle = aligned_load_of(Particle)

MARGIN = wp.constant(wp.float32(BOX_MARGIN))

TINY = wp.constant(wp.float32(1.0e-30))


@wp.func
def distance_squared(kernel: KernelData, log_response: float) -> float:
    """Returns the squared distance from the mean, in standard deviations, at which log(response) is ``log_response``.

    ``log_response`` is at most 0.
    """
    if kernel.degree == 0:
        distance = (1.0 - wp.exp(log_response)) / kernel.falloff
        return distance * distance
    exponent = -log_response / kernel.falloff
    if kernel.degree == 2:
        return exponent
    return wp.pow(exponent, 2.0 / float(kernel.degree))


@wp.func
def reach_squared(kernel: KernelData, opacity: float) -> float:
    """Returns the squared distance, in standard deviations, up to which rays hit a Gaussian; negative: never.

    A Gaussian ends where its alpha falls to 1/255, or earlier where its response falls to the kernel's minimum.
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
    """Returns a Gaussian's alpha at a squared canonical distance within its reach, for kernels of any degree."""
    if kernel.degree == 0:
        return wp.min(wp.exp(log_opacity) * wp.max(1.0 - kernel.falloff * wp.sqrt(distance2), 0.0), ALPHA_LIMIT)
    return alpha_from_log(log_opacity - kernel.falloff * wp.pow(distance2, 0.5 * float(kernel.degree)))


@wp.func
def canonical_from_object(rotation: wp.quat, scale: wp.vec3) -> wp.mat33:
    """Returns the inverse of rotation times scale: it maps object space to a Gaussian's canonical space."""
    axes = wp.quat_to_matrix(rotation)
    return wp.matrix_from_rows(
        wp.vec3(axes[0, 0], axes[1, 0], axes[2, 0]) / scale[0],
        wp.vec3(axes[0, 1], axes[1, 1], axes[2, 1]) / scale[1],
        wp.vec3(axes[0, 2], axes[1, 2], axes[2, 2]) / scale[2],
    )


@wp.func
def particle_of(kernel: KernelData, gaussians: GaussianData, i: int) -> Particle:
    """Prepares Gaussian ``i`` for ray intersection: the record that the leaves of a BVH store."""
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
    """Returns the axis-aligned box, object space, around the ellipsoid within which rays hit Gaussian ``i``.

    The box grows by a few units in the last place of its longest side, to cover rounding of rotation, box and ray. It
    is inverted if rays never hit the Gaussian.
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
    """Returns the unit normal, object space, towards the ray, where a ray enters the ellipsoid of Gaussian ``i``.

    ``origin`` and ``direction`` of the ray are in object space, ``ray`` itself is in world space.
    """
    scales = gaussians.scales[i]
    reach2 = reach_squared(instance.kernel, gaussians.opacities[i])
    path = ray.path_length + wp.dot(gaussians.means[i] - origin, direction) * instance.scale * instance.scale
    footprint = footprint_of_ray(instance.footprint, ray.spread, instance.scale)
    variance = footprint_variance(footprint, path, instance.scale * wp.max(scales))
    for k in range(3):
        scales[k] = wp.sqrt(scales[k] * scales[k] + variance)
    smallest = wp.min(scales)
    canonical = smallest * canonical_from_object(gaussians.rotations[i], scales)
    start = canonical * (origin - gaussians.means[i])
    return entry_normal(canonical, start, direction, smallest * smallest * reach2)


@wp.func
def gaussian_color(gaussians: GaussianData, i: int, eye: wp.vec3, sh_degree: int) -> wp.vec3:
    """Returns the display-referred colour of Gaussian ``i`` as seen from ``eye``, object space."""
    degree = wp.min(sh_degree, int(wp.sqrt(float(gaussians.sh_count))) - 1)
    return sh_color(gaussians.sh, i * gaussians.sh_count, degree, wp.normalize(gaussians.means[i] - eye))


@wp.func
def gaussian_facing(gaussians: GaussianData, i: int, eye: wp.vec3) -> wp.vec3:
    """Returns the unit normal of the max-density plane of Gaussian ``i`` as seen from ``eye``; both in object space."""
    rotation = wp.quat_to_matrix(gaussians.rotations[i])
    return gaussian_normal(rotation, gaussians.scales[i], eye - gaussians.means[i])


# --- Intersection of single rays, equal to that of packets (docs/method/ray_tracing.md#hits) ---


@wp.func
def world_ray(i: int, footprint: float, rays: RayData) -> TreeRay:
    """Sets up ray ``i`` in world space, for the top-level tree over all splat instances.

    ``footprint`` is the largest standard deviation by which the ray widens Gaussians of any instance, in pixel widths.
    """
    width = footprint_of_ray(footprint, rays.spread[i], 1.0)
    return tree_ray(rays.origin[i], rays.direction[i], width, rays.path_length[i], HIT_PEAK)


@wp.func
def ray_in_instance(i: int, instance: SplatInstanceData, hit_distance: int, rays: RayData) -> TreeRay:
    """Sets up ray ``i`` in the object space of a splat instance; ``hit_distance`` is HIT_PEAK, HIT_HULL or HIT_MEAN."""
    origin = instance.object_from_world * rays.origin[i] + instance.object_from_world_offset
    direction = instance.object_from_world * rays.direction[i]
    footprint = footprint_of_ray(instance.footprint, rays.spread[i], instance.scale)
    return tree_ray(origin, direction, footprint, rays.path_length[i], hit_distance)


@wp.func
def hit_particle(
    particle: Particle, ray: TreeRay, scale: float, hit_distance: int, begin: float, end: float
) -> ParticleHit:
    """Intersects a single ray with a Gaussian, widened by the ray's footprint.

    ``scale`` is the uniform scale from object to world space. The response must peak before distance ``end``; hits that
    peak no farther than ``begin`` are marked as near.
    """
    hit = ParticleHit()
    hit.t = FAR
    w = particle.canonical_from_object
    away = ray.origin - particle.mean
    middle = -wp.dot(away, ray.direction) * scale * scale
    c = w * away
    e = w * ray.direction
    if ray.footprint > 0.0:
        path = ray.path_length + middle
        variance = footprint_variance(ray.footprint, path, scale * particle.largest_scale)
        # A Gaussian that is wider on an axis has a shorter row of the canonical transform there.
        sharp = wp.vec3(wp.length_sq(w[0]), wp.length_sq(w[1]), wp.length_sq(w[2]))
        for k in range(3):
            shorter = 1.0 / wp.sqrt(1.0 + variance * sharp[k])
            c[k] = shorter * c[k]
            e[k] = shorter * e[k]
    across = wp.cross(c, e)  # c + t e would cancel for thin Gaussians
    across2 = wp.dot(across, across)
    along2 = wp.dot(e, e)
    peak = -wp.dot(c, e)
    if across2 <= particle.reach2 * along2 and peak > 0.0 and peak < end * along2:
        hit.distance2 = across2 / along2
        hit.t = peak / along2
        hit.is_near = not peak > begin * along2
        if hit_distance == HIT_MEAN:
            hit.t = middle
        if hit_distance == HIT_HULL:
            hit.t -= wp.sqrt(larger(particle.reach2 - hit.distance2, 0.0) / along2)
    return hit


@wp.func
def alpha_at(kernel: KernelData, particle: Particle, distance2: float) -> float:
    """Returns the alpha of a Gaussian at a squared canonical distance within its reach."""
    if kernel.degree == 2:
        return alpha_from_log(particle.log_opacity - 0.5 * distance2)
    return alpha_of_degree(kernel, particle.log_opacity, distance2)


@wp.func
def begin_past(t_min: float, offset: float, offset_absolute: float, particle: Particle, scale: float) -> float:
    """Returns the smaller of ``t_min`` and ``offset * largest scale + offset_absolute`` of a Gaussian.

    From this distance on, the Gaussian may be hit by a ray that starts at a surface. ``scale`` is the uniform scale
    from object to world.
    """
    return lesser(t_min, offset * scale * particle.largest_scale + offset_absolute)


# --- Depth of the surface (docs/method/rasterisation.md#iso-opacity-surface) ---

SCALES_MAX = wp.constant(wp.float32(SURFACE_DEPTH_SCALES))


@wp.func
def surface_peak(
    rotation: wp.quat, scale: wp.vec3, away: wp.vec3, along: wp.vec3, middle: float, largest_scale: float
) -> float:
    """Returns the distance along a ray at which a Gaussian responds most, at most three largest scales from its mean.

    The limit matters where pixel footprints show a Gaussian beyond its extent. ``away`` is the mean relative to the
    ray's origin, ``along`` the ray's direction, both object space. ``middle`` is the distance of the mean. ``middle``,
    ``largest_scale`` and the result are in units of the length of ``along``.
    """
    # Canonical space times the smallest scale, so that flat Gaussians stay inside float32.
    ratio = wp.cw_div(wp.vec3(wp.min(scale)), scale)
    canonical = wp.cw_mul(ratio, wp.quat_rotate_inv(rotation, along))
    start = wp.cw_mul(ratio, wp.quat_rotate_inv(rotation, away))
    beyond = wp.dot(start, canonical) / wp.length_sq(canonical) - middle
    if not wp.isfinite(beyond):
        beyond = float(0.0)
    reach = SCALES_MAX * largest_scale
    return middle + wp.clamp(beyond, -reach, reach)


@wp.func
def surface_distance(
    camera: wp.array[CameraData],
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    number: int,
    i: int,
    ray: wp.vec3,
    distance: float,
    mesh_z: float,
) -> float:
    """Returns the distance along a pixel's ray at which Gaussian ``i`` of instance ``number`` responds most.

    It is at most the distance of the mesh behind. ``ray`` is in camera space with z = 1. ``distance`` is the distance
    along the ray at the view depth of the Gaussian's mean, and ``mesh_z`` the view depth of the pixel's mesh; inf:
    none.
    """
    # Fields are read one by one, because copying these structs for each pixel would cost more than the depth.
    asset = instances[number].asset
    scale = assets[asset].scales[i]
    along = instances[number].object_from_world * (camera[0].world_from_camera * ray)
    away = assets[asset].means[i] - instances[number].eye
    length = wp.length(ray)
    largest_scale = instances[number].scale * wp.max(scale) / length
    depth_z = surface_peak(assets[asset].rotations[i], scale, away, along, distance / length, largest_scale)
    return wp.clamp(depth_z, camera[0].near, mesh_z) * length
