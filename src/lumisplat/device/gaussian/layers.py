"""Test whether a Gaussian near the origin of a ray belongs to another surface layer than the origin.

See docs/method/shadows.md#layers.
"""

import warp as wp

from lumisplat.device.structs.bvh import Particle
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

LAYER_FLATNESS = 0.15
"""Largest ratio of smallest to middle scale of a flat Gaussian, whose thin axis is its layer's normal (docs/adr/0088).
"""

LAYER_COSINE = 0.35
"""Cosine of 70 degrees; if the normals of two layers differ by more, their order alone distinguishes the layers."""

LAYER_HEIGHT = 0.0625
"""Smallest height above a surface of the mean of another layer's Gaussian, as a fraction of the shadow offset.

By default, the shadow offset is four scales, and the height a quarter of a scale. It is also the smallest distance of
the ray's origin from the plane of this Gaussian, unless the ray hits the Gaussian from the front."""

LAYER_RISE = 1.0
"""Increase of ``LAYER_HEIGHT`` for each unit of the cosine beyond ``LAYER_COSINE``, as a fraction of the shadow
offset.

For parallel layers, the height becomes 2.85 scales.
"""

LAYER_LIFT = 0.0625
"""Height above a surface of Gaussians at which bounced rays start, as a fraction of the shadow offset.

It is a quarter of a scale by default. From inside a layer, rays along the layer would leave it below and see the light
of its other side (docs/adr/0088)."""

COSINE = wp.constant(wp.float32(LAYER_COSINE))
FLATNESS = wp.constant(wp.float32(LAYER_FLATNESS))
HEIGHT = wp.constant(wp.float32(LAYER_HEIGHT))
LIFT = wp.constant(wp.float32(LAYER_LIFT))
RISE = wp.constant(wp.float32(LAYER_RISE))


@wp.func
def is_flat(scales: wp.vec3) -> bool:
    """Returns whether the thin axis of a Gaussian with these scales is the normal of its layer."""
    thin = wp.min(scales)
    middle = wp.max(wp.min(scales[0], scales[1]), wp.min(wp.max(scales[0], scales[1]), scales[2]))
    return thin < FLATNESS * middle


@wp.func
def above_layer(point: wp.vec3, normal: wp.vec3, near: float) -> wp.vec3:
    """Returns the origin of a ray that bounces at a surface of Gaussians, lifted so that the ray does not leave below.

    ``normal``, the normal of the layer, is unit and on the ray's side; if it is zero, the ray starts at ``point``.
    ``near`` is the distance within which Gaussians of the same layer do not block the ray, scene units; 0 for meshes.
    """
    return point + LIFT * near * normal


@wp.func
def thin_axis(particle: Particle, instance: SplatInstanceData) -> wp.vec3:
    """Returns the world-space unit normal of a flat Gaussian, on either side; zero for a Gaussian that is not flat."""
    rows = particle.canonical_from_object
    sharp = wp.vec3(wp.length_sq(rows[0]), wp.length_sq(rows[1]), wp.length_sq(rows[2]))
    thinnest = int(0)
    if sharp[1] > sharp[0]:
        thinnest = 1
    if sharp[2] > sharp[thinnest]:
        thinnest = 2
    next_sharp = wp.max(sharp[(thinnest + 1) % 3], sharp[(thinnest + 2) % 3])
    if not next_sharp < FLATNESS * FLATNESS * sharp[thinnest]:
        return wp.vec3(0.0)
    return instance.world_from_object * rows[thinnest] / wp.sqrt(sharp[thinnest])


@wp.func
def world_mean(particle: Particle, instance: SplatInstanceData) -> wp.vec3:
    """Returns the world-space mean of a Gaussian of an instance."""
    return instance.scale * (instance.world_from_object * (particle.mean - instance.object_from_world_offset))


@wp.func
def is_other_layer(
    i: int,
    near: float,
    mean: wp.vec3,
    axis: wp.vec3,
    particle: Particle,
    instance: SplatInstanceData,
    gaussians: GaussianData,
    rays: RayData,
) -> bool:
    """Returns whether a Gaussian that ray ``i`` hits near its origin belongs to another layer than the ray's surface.

    Both the hit Gaussian and the ray's surface must be flat. The hit Gaussian's mean must lie above the ray's surface,
    by little if the layers are inclined to each other and by more if they are parallel. The ray must hit the Gaussian
    from the front, or come from well in front of its plane.

    ``near`` is the distance within which Gaussians of the ray's own layer do not block it, scene units; ``mean`` is the
    hit Gaussian's mean, world space, and ``axis`` its ``thin_axis``.
    """
    normal = rays.normal[i]
    away = mean - rays.origin[i]
    height = wp.dot(normal, away)
    # Most Gaussians near a surface are not flat, or belong to its own layer.
    if not height > HEIGHT * near or wp.length_sq(axis) == 0.0:
        return False
    beyond = wp.max(wp.abs(wp.dot(normal, axis)) - COSINE, 0.0)
    if not height > (HEIGHT + RISE * beyond) * near:
        return False
    if gaussians.normals:
        if wp.dot(gaussians.normals[particle.index], instance.object_from_world * rays.direction[i]) < 0.0:
            return True
    # A surface extends slightly through the one that it meets, which does not block rays from there.
    return wp.abs(wp.dot(axis, away)) > HEIGHT * near
