"""Triangles that shine, as lights: points sampled by their power, and the density of such samples."""

import warp as wp

from lumisplat.constants import EMITTER_MARGIN, ENVIRONMENT_SHARE_STEPS, LIGHT_POWER_MAX
from lumisplat.device.light.environment import first_above, start_of
from lumisplat.device.light.mesh_interaction import emission_at
from lumisplat.device.mesh.mesh_surface import surface_alpha
from lumisplat.device.structs.light import EmitterTriangle, LightSample
from lumisplat.device.structs.shading import ShadingScene

wp.set_module_options({"enable_backward": False})

BELOW_ONE = wp.constant(wp.float32(1.0 - 1.0 / ENVIRONMENT_SHARE_STEPS))
NEARER = wp.constant(wp.float32(1.0 - EMITTER_MARGIN))
BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))


@wp.func
def emitter_share(k: int, scene: wp.array[ShadingScene]) -> float:
    """Probability with which triangle ``k`` of those that shine is sampled."""
    return scene[0].emitters.ends[k] - start_of(scene[0].emitters.ends, 0, k)


@wp.func
def area_density(share: float, across: wp.vec3, direction: wp.vec3, distance2: float) -> float:
    """Density, per steradian, of a point of a triangle that is sampled with probability ``share``.

    Args:
        share: Of the triangle.
        across: Cross product of two of its edges, world space.
        direction: Unit, to the point.
        distance2: To it, squared.
    """
    projected = 0.5 * wp.abs(wp.dot(across, direction))
    if projected <= 0.0:
        return 0.0
    return share * distance2 / projected


@wp.func
def point_above(triangle: EmitterTriangle, weights: wp.vec3, point: wp.vec3) -> wp.vec3:
    """A point of a triangle, lifted so far to the side of ``point`` that a ray from there does not hit the triangle.

    Barycentric ``weights`` say which. As ``spawn_point``, with the largest rounding error on the triangle.
    """
    inner = wp.vec3(
        wp.max(weights[0], triangle.inside[0]),
        wp.max(weights[1], triangle.inside[1]),
        wp.max(weights[2], triangle.inside[2]),
    )
    scale = 1.0 / (inner[0] + inner[1] + inner[2])
    place = triangle.corner + (scale * inner[1]) * triangle.edge1 + (scale * inner[2]) * triangle.edge2
    lift = wp.where(wp.dot(triangle.across, place - point) > 0.0, -triangle.lift, triangle.lift)
    return place + lift * triangle.across


@wp.func
def sample_emitter(point: wp.vec3, u: wp.vec2, which: float, scene: wp.array[ShadingScene]) -> LightSample:
    """A point of the triangles that shine, as ``point`` sees it.

    Args:
        point: World space.
        u: Random, 0..1 each: where on a triangle.
        which: Random, 0..1: on which.
        scene: With the triangles.
    """
    sample = LightSample()
    emitters = scene[0].emitters
    k = first_above(emitters.ends, 0, emitters.ends.shape[0], wp.min(which, BELOW_ONE))
    number = emitters.instances[k]
    triangle = emitters.triangles[k]
    root = wp.sqrt(u[0])
    weights = wp.vec3(1.0 - root, root * (1.0 - u[1]), root * u[1])
    way = point_above(triangle, weights, point) - point
    distance2 = wp.dot(way, way)
    if distance2 <= 0.0:
        return sample
    sample.distance = wp.sqrt(distance2)
    sample.direction = way / sample.distance
    sample.distance *= NEARER  # a shadow ray to there ends before the triangle, however its hit is rounded
    sample.density = area_density(emitter_share(k, scene), triangle.across, sample.direction, distance2)
    if sample.density > 0.0:
        instance = scene[0].mesh_instances[number]
        corners = scene[0].meshes.indices[instance.face_first + k - emitters.first[number]]
        coverage = surface_alpha(instance, scene[0].meshes, corners, weights)
        radiance = coverage * emission_at(number, corners, weights, sample.direction, scene)
        sample.irradiance = wp.min(radiance / sample.density, BRIGHTEST)
    return sample
