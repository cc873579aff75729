"""Whether a Gaussian near the surface that a ray leaves is of another layer (docs/method/shadows.md#layers)."""

import warp as wp

from lumisplat.device.structs.bvh import Particle
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import GaussianData, SplatInstanceData

LAYER_FLATNESS = 0.15
"""Smallest over middle scale of a Gaussian up to which its thin axis tells the layer that it is of (docs/adr/0088)."""

LAYER_COSINE = 0.35
"""Cosine between the normals of two layers up to which only their order decides: 70 degrees apart and more."""

LAYER_HEIGHT = 0.0625
"""How far before a surface the mean of a Gaussian of another layer stands at least, and how far before its plane the
surface, in shadow offsets: a quarter of a scale."""

LAYER_RISE = 1.0
"""By how much that rises with the cosine beyond ``LAYER_COSINE``: to 2.85 scales between parallel layers."""

LAYER_LIFT = 0.0625
"""How far above a surface of Gaussians rays begin that bounce there, in shadow offsets: a quarter of a scale. From
within a layer, those along it come out below and see what lights its other side (docs/adr/0088)."""

COSINE = wp.constant(wp.float32(LAYER_COSINE))
FLATNESS = wp.constant(wp.float32(LAYER_FLATNESS))
HEIGHT = wp.constant(wp.float32(LAYER_HEIGHT))
LIFT = wp.constant(wp.float32(LAYER_LIFT))
RISE = wp.constant(wp.float32(LAYER_RISE))


@wp.func
def is_flat(scales: wp.vec3) -> bool:
    """Whether the thin axis of a Gaussian with these scales is the normal of its layer."""
    thin = wp.min(scales)
    middle = wp.max(wp.min(scales[0], scales[1]), wp.min(wp.max(scales[0], scales[1]), scales[2]))
    return thin < FLATNESS * middle


@wp.func
def above_layer(point: wp.vec3, normal: wp.vec3, near: float) -> wp.vec3:
    """Returns where a ray begins that bounces at a surface of Gaussians: a little above it, not to come out below.

    ``normal`` of the layer is unit, on the side to which the ray goes; where it is zero, the ray begins at the point.
    ``near``: the offset within which Gaussians of that layer do not block the ray, scene units; 0 for meshes.
    """
    return point + LIFT * near * normal


@wp.func
def thin_axis(particle: Particle, instance: SplatInstanceData) -> wp.vec3:
    """Unit normal of a flat Gaussian, of either sign, world space; zero unless ``is_flat`` holds."""
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
    """Mean of a Gaussian of an instance, world space."""
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
    """Whether a Gaussian that ray ``i`` meets within the offset is of another layer than the surface that it leaves.

    Two flat Gaussians can tell: its mean stands before that surface, by little if it is turned away from it, by more
    if the two are parallel; and the ray meets it from the front, or comes from well before its plane.

    ``near`` is the offset within which Gaussians of the ray's own layer do not block it, scene units; ``mean`` of the
    Gaussian is in world space, and ``axis`` its ``thin_axis``.
    """
    normal = rays.normal[i]
    away = mean - rays.origin[i]
    height = wp.dot(normal, away)
    # Most Gaussians near a surface are not flat, or of its own layer.
    if not height > HEIGHT * near or wp.length_sq(axis) == 0.0:
        return False
    beyond = wp.max(wp.abs(wp.dot(normal, axis)) - COSINE, 0.0)
    if not height > (HEIGHT + RISE * beyond) * near:
        return False
    if gaussians.normals:
        if wp.dot(gaussians.normals[particle.index], instance.object_from_world * rays.direction[i]) < 0.0:
            return True
    # A surface reaches a little through the one that it ends at: from there, that is not in the way.
    return wp.abs(wp.dot(axis, away)) > HEIGHT * near
