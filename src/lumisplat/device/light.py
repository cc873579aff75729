"""How a point of a surface sees a light: from where, from how far, and how much arrives.

A hard light is a point at its centre. A soft one has its extent, and ``u`` picks a direction within it: the mean over
``u`` of irradiance times cosine is what all of the light gives.
"""

import math

import warp as wp

from lumisplat.constants import LIGHT_DISTANCE_MIN
from lumisplat.device.directions import TWO_PI, around
from lumisplat.device.light_structs import (
    LIGHT_DIRECTIONAL,
    LIGHT_HEADLIGHT,
    LIGHT_POINT,
    LIGHT_RECT,
    LIGHT_SPOT,
    LightData,
    LightSample,
)

wp.set_module_options({"enable_backward": False})

DISTANCE_MIN = wp.constant(wp.float32(LIGHT_DISTANCE_MIN))
PI = wp.constant(wp.float32(math.pi))


@wp.func
def window(light: LightData, distance: float) -> float:
    """How much of a light is left towards the end of its range (glTF, KHR_lights_punctual)."""
    share = distance / light.range
    share2 = share * share
    return wp.clamp(1.0 - share2 * share2, 0.0, 1.0)


@wp.func
def cone(light: LightData, direction: wp.vec3) -> float:
    """How much of its intensity a spot sends to a point that sees it in ``direction``.

    ``1 - cosine`` is half the squared distance of the two directions, which keeps its digits in small cones.
    """
    off = direction + light.direction
    share = (light.outer - 0.5 * wp.dot(off, off)) / (light.outer - light.inner)
    share = wp.clamp(share, 0.0, 1.0)
    return share * share


@wp.func
def sample_point(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """A point or spot; soft, a sphere of the same candela, seen in the cone that it fills."""
    sample = LightSample()
    offset = light.position - point
    distance = wp.length(offset)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    sample.distance = distance
    if distance <= 0.0:
        return sample
    center = offset / distance
    sample.direction = center
    candela = window(light, distance) * light.power
    if light.kind == LIGHT_SPOT:
        candela = cone(light, center) * candela
    near = DISTANCE_MIN
    if soft != 0 and light.radius > 0.0:
        near = wp.max(near, light.radius)
        if distance > near:
            ratio = light.radius / distance
            cosine = wp.sqrt((1.0 - ratio) * (1.0 + ratio))
            # 1 - cosine of the cone's edge, and of the direction in it.
            edge = ratio * ratio / (1.0 + cosine)
            lift = u[0] * edge
            sine2 = lift * (2.0 - lift)
            sample.direction = around(center, 1.0 - lift, wp.sqrt(sine2), u[1])
            inside = wp.max((ratio - sine2 / ratio) * ratio, 0.0)
            sample.distance = distance * wp.max(1.0 - lift - wp.sqrt(inside), 0.0)
            sample.irradiance = (2.0 / (1.0 + cosine) / distance / distance) * candela
            sample.density = 1.0 / wp.max(TWO_PI * edge, 1e-30)
            return sample
    distance = wp.max(distance, near)
    sample.irradiance = candela / distance / distance
    return sample


@wp.func
def sample_directional(light: LightData, soft: int, u: wp.vec2) -> LightSample:
    """Parallel light; soft, a disc of its angular radius in the sky."""
    sample = LightSample()
    sample.direction = -light.direction
    sample.distance = wp.inf
    sample.irradiance = light.power
    if soft != 0 and light.radius > 0.0:
        sine = wp.sin(0.5 * light.radius)
        edge = 2.0 * sine * sine
        lift = u[0] * edge
        sample.direction = around(-light.direction, 1.0 - lift, wp.sqrt(lift * (2.0 - lift)), u[1])
        # The cone's solid angle, 2 pi edge, over what of it faces a surface, pi edge (2 - edge).
        sample.irradiance = (2.0 / (2.0 - edge)) * light.power
        sample.density = 1.0 / wp.max(TWO_PI * edge, 1e-30)
    return sample


@wp.func
def sample_rect(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """A parallelogram: all of it at its centre; soft, at one of its points."""
    sample = LightSample()
    offset = light.position - point
    if soft != 0:
        offset += (u[0] - 0.5) * light.edge_u + (u[1] - 0.5) * light.edge_v
    distance = wp.length(offset)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    sample.distance = distance
    if distance <= 0.0:
        return sample
    sample.direction = offset / distance
    cosine = -wp.dot(sample.direction, light.direction)
    if cosine <= 0.0:
        return sample
    distance = wp.max(distance, DISTANCE_MIN)
    solid_angle = cosine * wp.length(wp.cross(light.edge_u, light.edge_v)) / distance / distance
    if soft != 0:
        sample.density = 1.0 / wp.max(solid_angle, 1e-30)
    else:
        # A hard light shines no brighter than a sky full of it.
        solid_angle = wp.min(solid_angle, PI)
    sample.irradiance = solid_angle * light.power
    return sample


@wp.func
def sample_light(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """How ``point`` sees a light that is no environment.

    Args:
        light: The light.
        point: World space.
        soft: 0: all of the light is at its centre; 1: it has an extent.
        u: Random, 0..1 each; not used where there is one direction only.
    """
    if light.kind == LIGHT_POINT or light.kind == LIGHT_SPOT:  # noqa: PLR1714
        return sample_point(light, point, soft, u)
    if light.kind == LIGHT_DIRECTIONAL:
        return sample_directional(light, soft, u)
    if light.kind == LIGHT_RECT:
        return sample_rect(light, point, soft, u)
    sample = LightSample()
    offset = light.position - point
    sample.distance = wp.length(offset)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    if light.kind == LIGHT_HEADLIGHT and sample.distance > 0.0:
        sample.direction = offset / sample.distance
        sample.irradiance = light.power
    return sample
