"""Blending of the Gaussians along a ray, and the random decision of STRATEGY_PASS whether the ray ends.

The equations are in docs/method/ray_tracing.md#strategies.
"""

import warp as wp

from lumisplat.device.gaussian.particle import ellipsoid_normal, gaussian_color, gaussian_facing
from lumisplat.device.math.random import draw
from lumisplat.device.splat.blending import begin_relit, empty_pixel, instance_of, iso_of, lay_behind
from lumisplat.device.splat.projection import BEYOND_MAX, tinted, towards
from lumisplat.device.structs.bvh import STRATEGY_HIT, SceneBvh, TraceData
from lumisplat.device.structs.raster import BlendState
from lumisplat.device.structs.rays import GaussianHits, HitProfiles, Ray
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData


@wp.func
def load_pixel(hits: GaussianHits, ray: int) -> BlendState:
    """Reads the blending state of a ray from its element of the Gaussian hits."""
    pixel = BlendState()
    pixel.color = hits.color[ray]
    pixel.normal = hits.normal[ray]
    pixel.transmittance = hits.transmittance[ray]
    pixel.first = hits.gaussian[ray]
    pixel.surface = wp.where(hits.depth[ray] < wp.inf, pixel.first, -1)
    pixel.hits = hits.hits[ray]
    return pixel


@wp.func
def store_pixel(hits: GaussianHits, ray: int, pixel: BlendState):
    """Writes the blending state of a ray to its element of the Gaussian hits, except for the surface depth."""
    hits.color[ray] = pixel.color
    hits.normal[ray] = pixel.normal
    hits.transmittance[ray] = pixel.transmittance
    hits.gaussian[ray] = wp.where(pixel.surface >= 0, pixel.surface, pixel.first)
    hits.hits[ray] = pixel.hits


@wp.func
def hit_color(view: TraceData, instance: SplatInstanceData, gaussians: GaussianData, i: int, eye: wp.vec3) -> wp.vec3:
    """Returns the display-referred colour, SH or albedo, of Gaussian ``i`` as seen from ``eye``, object space."""
    if instance.shows_albedo != 0:
        return tinted(instance, gaussians.albedo[i])
    return tinted(instance, gaussian_color(gaussians, i, eye, wp.min(view.sh_degree, instance.sh_degree)))


@wp.func
def facing_normal(instance: SplatInstanceData, gaussians: GaussianData, i: int, eye: wp.vec3) -> wp.vec3:
    """Returns the world-space unit normal of Gaussian ``i``'s max-density plane, towards ``eye``, object space."""
    return instance.world_from_object * gaussian_facing(gaussians, i, eye)


@wp.func
def hit_iso(pixel: BlendState, view: TraceData, scene: SceneBvh, index: int) -> float:
    """Returns the transmittance at the surface of Gaussian ``index``'s instance, if the ray has no surface yet."""
    iso = view.depth_iso_transmittance
    if pixel.surface >= 0 or view.strategy == STRATEGY_HIT:
        return iso
    return iso_of(scene.instances, index, iso)


@wp.func
def blend_hit(pixel: BlendState, view: TraceData, scene: SceneBvh, ray: Ray, index: int, alpha: float) -> BlendState:
    """Blends Gaussian ``index``, counted over all splat instances, behind those that a ray has already blended.

    Colour and normal are those that the eye, unfolded at all mirrors, would see: a plane mirror shows what a mirrored
    camera sees.
    """
    if scene.eye_normals:
        facing = scene.eye_normals[index]
        if wp.length_sq(facing) > 0.0:
            return lay_behind(pixel, scene.eye_colors[index], facing, index, alpha, hit_iso(pixel, view, scene, index))
    number = instance_of(scene.instances, index)
    instance = scene.instances[number]
    i = index - instance.first
    gaussians = scene.assets[instance.asset].gaussians
    origin = instance.object_from_world * ray.origin + instance.object_from_world_offset
    direction = instance.object_from_world * ray.direction
    eye = origin - ray.path_length * direction
    color = wp.vec3()
    if scene.eye_colors:
        color = scene.eye_colors[index]
    else:
        color = hit_color(view, instance, gaussians, i, eye)
    normal = wp.vec3()
    if instance.stored_normals != 0:
        normal = towards(gaussians.normals[i], -direction, wp.where(ray.spread > 0.0, BEYOND_MAX, 0.0))
        normal = instance.world_from_object * normal
    elif view.ellipsoid_normal != 0:
        normal = instance.world_from_object * ellipsoid_normal(instance, gaussians, i, origin, direction, ray)
    else:
        normal = facing_normal(instance, gaussians, i, eye)
    return lay_behind(pixel, color, normal, index, alpha, hit_iso(pixel, view, scene, index))


@wp.func
def record_hit(profiles: wp.array[HitProfiles], ray: int, pixel: BlendState, t: float, index: int, alpha: float):
    """Writes a ray's last blended hit, of Gaussian ``index``, to the ray's elements of ``profiles``.

    A ray never writes beyond its own elements, even if another packet's rounding gives it more hits than were counted.
    """
    row = profiles[0].first[ray] + pixel.hits - 1
    if row < profiles[0].first[ray + 1]:
        profiles[0].t[row] = t
        profiles[0].alpha[row] = alpha
        profiles[0].transmittance[row] = pixel.transmittance
        profiles[0].gaussian[row] = index


@wp.func
def end_pass(pixel: BlendState, sample_key: wp.uint32, last: int) -> BlendState:
    """Ends a ray at random, with a probability equal to the opacity of the hits blended since the last decision.

    If it ends, these hits (the pass) stand for the whole ray: the transmittance becomes 0, and the surface becomes
    ``last``, their farthest Gaussian, if they have no surface. Otherwise, the next pass starts empty. The expectation
    equals full blending: a pass is reached with the transmittance of the passes before it, accepted with its opacity,
    and divided by its opacity.
    """
    opacity = 1.0 - pixel.transmittance
    if draw(sample_key, wp.uint32(last)) >= opacity:
        return empty_pixel()
    pixel.color = pixel.color / opacity
    pixel.normal = pixel.normal / opacity
    pixel.transmittance = 0.0
    if pixel.surface < 0:
        pixel.surface = last
    return pixel


@wp.func
def close_pass(
    pixel: BlendState, hits: GaussianHits, ray: int, sample_key: wp.uint32, depth: float, last: int
) -> BlendState:
    """Decides at random, by ``end_pass``, whether a ray ends, and updates the depth of its surface.

    ``last`` is the farthest Gaussian blended since the last decision, and ``depth`` the distance of its surface.
    """
    opacity = 1.0 - pixel.transmittance
    pixel = end_pass(pixel, sample_key, last)
    if hits.relit_weight:
        if pixel.surface < 0:
            begin_relit(hits, ray)
        else:
            hits.relit_color[ray] = hits.relit_color[ray] / opacity
            hits.relit_weight[ray] = hits.relit_weight[ray] / opacity
    if pixel.surface < 0:
        hits.depth[ray] = wp.inf
    elif pixel.surface == last:
        hits.depth[ray] = depth
    return pixel
