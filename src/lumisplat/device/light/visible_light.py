"""Lights that paths see: rectangles and spheres that rays pass through, and what they shine there."""

import warp as wp

from lumisplat.device.light.light import NEAREST2, TINY
from lumisplat.device.math.directions import PI, TWO_PI
from lumisplat.device.structs.light import LIGHT_RECT, LightData
from lumisplat.device.structs.path import LightCrossing

wp.set_module_options({"enable_backward": False})


@wp.func
def rect_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Where a ray meets the side of a parallelogram that shines."""
    crossing = LightCrossing()
    crossing.t = wp.inf
    cosine = -wp.dot(direction, light.direction)
    if cosine <= 0.0:
        return crossing
    t = wp.dot(origin - light.position, light.direction) / cosine
    offset = origin + t * direction - light.position
    across = wp.cross(light.edge_u, light.edge_v)
    area2 = wp.dot(across, across)
    u = wp.dot(wp.cross(offset, light.edge_v), across) / area2
    v = wp.dot(wp.cross(light.edge_u, offset), across) / area2
    if t > 0.0 and wp.max(wp.abs(u), wp.abs(v)) <= 0.5:
        crossing.t = t
        crossing.radiance = light.power
        crossing.density = wp.max(t * t, NEAREST2) / wp.max(cosine * wp.sqrt(area2), TINY)
    return crossing


@wp.func
def sphere_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Where a ray from outside enters a sphere."""
    crossing = LightCrossing()
    crossing.t = wp.inf
    offset = light.position - origin
    distance2 = wp.dot(offset, offset)
    radius2 = light.radius * light.radius
    along = wp.dot(offset, direction)
    beside = offset - along * direction
    inside = radius2 - wp.dot(beside, beside)
    if distance2 > radius2 and along > 0.0 and inside >= 0.0:
        ratio2 = radius2 / distance2
        edge = ratio2 / (1.0 + wp.sqrt(1.0 - ratio2))
        crossing.t = along - wp.sqrt(inside)
        crossing.radiance = light.power / wp.max(PI * radius2, TINY)
        crossing.density = 1.0 / wp.max(TWO_PI * edge, TINY)
    return crossing


@wp.func
def light_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Where a ray meets a light that is visible, what that shines, and how densely it is sampled there."""
    if light.kind == LIGHT_RECT:
        return rect_crossing(light, origin, direction)
    return sphere_crossing(light, origin, direction)
