"""Where a single ray hits a Gaussian (docs/method/ray_tracing.md#hits), as packets do, one ray at a time."""

import warp as wp

from lumisplat.device.bvh.footprint import footprint_of_ray, footprint_variance
from lumisplat.device.bvh.node_test import larger, lesser
from lumisplat.device.bvh.ray_nodes import tree_ray
from lumisplat.device.gaussian.particle import alpha_of_degree
from lumisplat.device.splat.projection import alpha_from_log
from lumisplat.device.structs.bvh import FAR, HIT_HULL, HIT_MEAN, HIT_PEAK, Particle
from lumisplat.device.structs.packet import ParticleHit, TreeRay
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import KernelData, SplatInstanceData

wp.set_module_options({"enable_backward": False})


@wp.func
def world_ray(i: int, footprint: float, rays: RayData) -> TreeRay:
    """Ray ``i`` in the space of the tree over the instances, whose widest footprint is this one."""
    width = footprint_of_ray(footprint, rays.spread[i], 1.0)
    return tree_ray(rays.origin[i], rays.direction[i], width, rays.path_length[i], HIT_PEAK)


@wp.func
def ray_in_instance(i: int, instance: SplatInstanceData, hit_distance: int, rays: RayData) -> TreeRay:
    """Ray ``i`` in the space of an instance, whose Gaussians it hits at one of HIT_PEAK, HIT_HULL, HIT_MEAN."""
    origin = instance.object_from_world * rays.origin[i] + instance.object_from_world_offset
    direction = instance.object_from_world * rays.direction[i]
    footprint = footprint_of_ray(instance.footprint, rays.spread[i], instance.scale)
    return tree_ray(origin, direction, footprint, rays.path_length[i], hit_distance)


@wp.func
def hit_particle(
    particle: Particle, ray: TreeRay, scale: float, hit_distance: int, begin: float, end: float
) -> ParticleHit:
    """Where a ray hits a Gaussian, widened by the ray's footprint.

    Args:
        particle: The Gaussian.
        ray: In its space.
        scale: World from that space.
        hit_distance: HIT_PEAK, HIT_HULL or HIT_MEAN.
        begin: Hits whose response peaks up to this distance are near ones.
        end: The peak must lie before this one.
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
    """Alpha of a Gaussian at a squared canonical distance within its reach."""
    if kernel.degree == 2:
        return alpha_from_log(particle.log_opacity - 0.5 * distance2)
    return alpha_of_degree(kernel, particle.log_opacity, distance2)


@wp.func
def begin_past(t_min: float, offset: float, offset_absolute: float, particle: Particle, scale: float) -> float:
    """From where on a Gaussian counts: ``t_min``, or nearer if it is small."""
    return lesser(t_min, offset * scale * particle.largest_scale + offset_absolute)
