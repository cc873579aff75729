"""Samples of lights from a point of a surface: direction, distance and irradiance.

A hard light is sampled at its centre. A soft one has an extent, and ``u`` samples a direction within it: the mean of
irradiance times cosine over ``u`` is the irradiance by the whole light.

The equations are in docs/method/lighting.md#lights.
"""

import warp as wp

from lumisplat.constants import LIGHT_DISTANCE_MIN, LIGHT_POWER_MAX
from lumisplat.device.math.directions import PI, TWO_PI, around
from lumisplat.device.structs.light import (
    LIGHT_DIRECTIONAL,
    LIGHT_HEADLIGHT,
    LIGHT_POINT,
    LIGHT_RECT,
    LIGHT_SPOT,
    LightData,
    LightSample,
)

wp.set_module_options({"enable_backward": False})

NEAREST2 = wp.constant(wp.float32(LIGHT_DISTANCE_MIN**2))
BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))
TINY = wp.constant(wp.float32(1e-30))
"""Smallest divisor, and squared distance below which a light is at the point itself and has no direction."""


@wp.func
def window(light: LightData, distance2: float) -> float:
    """Attenuation of a light towards the end of its range (glTF, KHR_lights_punctual)."""
    if light.range == wp.inf:
        return 1.0
    share2 = distance2 / (light.range * light.range)
    return wp.clamp(1.0 - share2 * share2, 0.0, 1.0)


@wp.func
def cone(light: LightData, direction: wp.vec3) -> float:
    """Angular attenuation of a spot at a point that sees it in ``direction``.

    ``1 - cosine`` is half the squared distance of the two unit vectors, which keeps its digits in small cones.
    """
    off = direction + light.direction
    share = (light.outer - 0.5 * wp.dot(off, off)) / wp.max(light.outer - light.inner, TINY)
    share = wp.clamp(share, 0.0, 1.0)
    return share * share


@wp.func
def sample_point(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """A point or spot; soft, a sphere of the same candela, sampled in the cone that it subtends."""
    sample = LightSample()
    offset = light.position - point
    distance2 = wp.dot(offset, offset)
    distance = wp.sqrt(distance2)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    sample.distance = distance
    if distance2 < TINY:
        return sample
    inverse = 1.0 / distance
    sample.direction = inverse * offset
    share = window(light, distance2)
    if light.kind == LIGHT_SPOT:
        share *= cone(light, sample.direction)
    nearest2 = NEAREST2
    if soft != 0 and light.radius > 0.0:
        ratio = light.radius / distance
        if ratio < 1.0:
            cosine = wp.sqrt((1.0 - ratio) * (1.0 + ratio))
            # 1 - cosine of the cone's edge, and of the direction in it.
            edge = ratio * ratio / (1.0 + cosine)
            lift = u[0] * edge
            sine2 = lift * (2.0 - lift)
            sample.direction = around(sample.direction, 1.0 - lift, wp.sqrt(sine2), u[1])
            inside = wp.max((ratio - sine2 / ratio) * ratio, 0.0)
            sample.distance = distance * wp.max(1.0 - lift - wp.sqrt(inside), 0.0)
            sample.density = 1.0 / wp.max(TWO_PI * edge, TINY)
            share *= 2.0 / (1.0 + cosine)
        else:
            nearest2 = wp.max(nearest2, light.radius * light.radius)
    if distance2 > nearest2:
        share *= inverse * inverse
    else:
        share /= nearest2
    sample.irradiance = wp.min(share * light.power, BRIGHTEST)
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
        # The cone's solid angle, 2 pi edge, over its projected solid angle, pi edge (2 - edge).
        sample.irradiance = (2.0 / (2.0 - edge)) * light.power
        sample.density = 1.0 / wp.max(TWO_PI * edge, TINY)
    return sample


@wp.func
def sample_rect(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """A parallelogram: all of it at its centre; soft, at a random point of it."""
    sample = LightSample()
    offset = light.position - point
    if soft != 0:
        offset += (u[0] - 0.5) * light.edge_u + (u[1] - 0.5) * light.edge_v
    distance2 = wp.dot(offset, offset)
    sample.distance = wp.sqrt(distance2)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    if distance2 < TINY:
        return sample
    sample.direction = (1.0 / sample.distance) * offset
    cosine = -wp.dot(sample.direction, light.direction)
    if cosine <= 0.0:
        return sample
    area = wp.length(wp.cross(light.edge_u, light.edge_v))
    solid_angle = wp.min(cosine * area / wp.max(distance2, NEAREST2), 1.0 / NEAREST2)
    if soft != 0:
        sample.density = 1.0 / wp.max(solid_angle, TINY)
    else:
        # A hard light gives no more irradiance than a whole sky of its radiance.
        solid_angle = wp.min(solid_angle, PI)
    sample.irradiance = wp.min(solid_angle * light.power, BRIGHTEST)
    return sample


@wp.func
def sample_light(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """A sample of a light, as ``point`` sees it.

    Args:
        light: Any light but the environment.
        point: World space.
        soft: 0: all of the light is at its centre; 1: it has an extent.
        u: Random, 0..1 each; not used by lights that have one direction only.
    """
    if light.kind == LIGHT_POINT or light.kind == LIGHT_SPOT:  # noqa: PLR1714
        return sample_point(light, point, soft, u)
    if light.kind == LIGHT_DIRECTIONAL:
        return sample_directional(light, soft, u)
    if light.kind == LIGHT_RECT:
        return sample_rect(light, point, soft, u)
    sample = LightSample()
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    if light.kind == LIGHT_HEADLIGHT:
        offset = light.position - point
        sample.distance = wp.length(offset)
        if sample.distance > 0.0:
            sample.direction = (1.0 / sample.distance) * offset
            sample.irradiance = light.power
    return sample
