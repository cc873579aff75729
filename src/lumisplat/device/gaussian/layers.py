"""Test whether a Gaussian near the origin of a ray belongs to another surface layer than the origin.

See docs/method/shadows.md#layers.
"""

import warp as wp

from lumisplat.device.structs.bvh import Particle
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

LAYER_FLATNESS = 0.15
"""A Gaussian is flat if its smallest scale is below this fraction of its middle scale (docs/adr/0088).

The thin axis of a flat Gaussian is the normal of its layer, a surface such as a wall.
"""

LAYER_COSINE = 0.35
"""If the cosine between two layers' normals is at most this (70 degrees), the height ``LAYER_HEIGHT`` separates them.

More parallel layers need a larger height, see ``LAYER_RISE``."""

LAYER_HEIGHT = 0.0625
"""A Gaussian is of another layer only if its mean is higher above the surface than this fraction of the shadow offset.

By default, the shadow offset is four scales, and the height a quarter of a scale. The ray's origin must also be at
least this far from the Gaussian's plane, unless the ray hits the Gaussian from the front."""

LAYER_RISE = 1.0
"""Added to ``LAYER_HEIGHT`` for each unit by which the cosine between two layers' normals exceeds ``LAYER_COSINE``.

It is a fraction of the shadow offset; for parallel layers, the height becomes 2.85 scales.
"""

LAYER_LIFT = 0.0625
"""Height above a surface of Gaussians at which rays that leave it start, as a fraction of the shadow offset.

It is a quarter of a scale by default. A ray along the layer that started inside the layer would come out below and see
the light on the other side (docs/adr/0088)."""

COSINE = wp.constant(wp.float32(LAYER_COSINE))
FLATNESS = wp.constant(wp.float32(LAYER_FLATNESS))
HEIGHT = wp.constant(wp.float32(LAYER_HEIGHT))
LIFT = wp.constant(wp.float32(LAYER_LIFT))
RISE = wp.constant(wp.float32(LAYER_RISE))


@wp.func
def is_flat(scales: wp.vec3) -> bool:
    """Returns whether a Gaussian with these scales is flat, so that its thin axis is the normal of a surface layer."""
    thin = wp.min(scales)
    middle = wp.max(wp.min(scales[0], scales[1]), wp.min(wp.max(scales[0], scales[1]), scales[2]))
    return thin < FLATNESS * middle


@wp.func
def above_layer(point: wp.vec3, normal: wp.vec3, near: float) -> wp.vec3:
    """Returns ``point`` lifted along ``normal`` by a fraction of ``near``: the origin of a ray that leaves a layer.

    ``normal``, the unit normal of the layer of flat Gaussians, is on the ray's side; zero: no layer, and no lift.
    ``near`` is the distance within which Gaussians of the same layer do not block the ray, scene units; 0 for meshes.
    """
    return point + LIFT * near * normal


@wp.func
def thin_axis(particle: Particle, instance: SplatInstanceData) -> wp.vec3:
    """Returns the world-space unit vector along a flat Gaussian's thin axis, of either sign; zero if it is not flat."""
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
    """Returns whether a Gaussian that ray ``i`` hits close to its origin is of another surface than the ray's origin.

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
