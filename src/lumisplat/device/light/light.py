"""All types of lights except the environment: sampling from a surface point, ray intersection, and bounds for a cell.

A hard light is sampled at its centre. A soft light has an extent, and ``u`` samples a direction within the extent: the
mean of irradiance times cosine over ``u`` is the irradiance by the whole light. The environment is in emitters.py.

The equations are in docs/method/lighting.md#lights.
"""

import warp as wp

from lumisplat.constants import LIGHT_DISTANCE_MIN, LIGHT_POWER_MAX, LUMINANCE
from lumisplat.device.math.directions import PI, TWO_PI, around
from lumisplat.device.structs.shading import LightCrossing, LightData, LightSample

LIGHT_POINT: int = wp.constant(0)
"""Type of a light that is a point or, with a radius, a sphere."""
LIGHT_SPOT: int = wp.constant(1)
LIGHT_DIRECTIONAL: int = wp.constant(2)
LIGHT_RECT: int = wp.constant(3)
LIGHT_ENVIRONMENT: int = wp.constant(4)
LIGHT_DISK: int = wp.constant(6)
LIGHT_HEADLIGHT: int = wp.constant(5)
"""Type of a light at the camera's eye without falloff or shadow."""

NEAREST2 = wp.constant(wp.float32(LIGHT_DISTANCE_MIN**2))
BRIGHTEST = wp.constant(wp.vec3(LIGHT_POWER_MAX, LIGHT_POWER_MAX, LIGHT_POWER_MAX))
WEIGHTS = wp.constant(wp.vec3(*LUMINANCE))
TINY = wp.constant(wp.float32(1e-30))
"""Smallest divisor; also the squared distance below which a light coincides with the point and has no direction."""


@wp.func
def window(light: LightData, distance2: float) -> float:
    """Returns the factor, 1 to 0, by which a light fades out towards its range (glTF, KHR_lights_punctual).

    It is 1 for a light without range.
    """
    if light.range == wp.inf:
        return 1.0
    share2 = distance2 / (light.range * light.range)
    return wp.clamp(1.0 - share2 * share2, 0.0, 1.0)


@wp.func
def cone(light: LightData, direction: wp.vec3) -> float:
    """Returns the factor, 0..1, by which a spot is dimmed at a point outside its inner cone.

    ``direction`` leads from the point to the spot. ``1 - cosine`` of the angle from the spot's axis is computed as half
    the squared distance of two unit vectors, because this keeps its digits for narrow cones.
    """
    off = direction + light.direction
    return cone_share(light, wp.dot(off, off))


@wp.func
def cone_share(light: LightData, off2: float) -> float:
    """Returns ``cone`` from the squared distance of the two unit vectors: spot's axis, and direction from the spot."""
    share = (light.outer - 0.5 * off2) / wp.max(light.outer - light.inner, TINY)
    share = wp.clamp(share, 0.0, 1.0)
    return share * share


@wp.func
def attenuated(share: float, distance2: float, inverse: float, nearest2: float) -> float:
    """Returns ``share`` over the squared distance, at least ``nearest2``, to a light; ``inverse`` is 1 / distance."""
    if distance2 > nearest2:
        return share * (inverse * inverse)
    return share / nearest2


@wp.func
def sample_point(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """Samples a point light or spot: its centre or, if soft, a direction within the cone that its sphere subtends.

    The sphere has the light's radius and its luminous intensity.
    """
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
            # ``edge`` is 1 - cosine of the cone's edge, ``lift`` of the direction in it.
            edge = ratio * ratio / (1.0 + cosine)
            lift = u[0] * edge
            sine2 = lift * (2.0 - lift)
            sample.direction = around(sample.direction, 1.0 - lift, wp.sqrt(sine2), u[1])
            inside = wp.max((ratio - sine2 / ratio) * ratio, 0.0)
            sample.distance = distance * wp.max(1.0 - lift - wp.sqrt(inside), 0.0)
            sample.pdf = 1.0 / wp.max(TWO_PI * edge, TINY)
            share *= 2.0 / (1.0 + cosine)
        else:
            nearest2 = wp.max(nearest2, light.radius * light.radius)
    share = attenuated(share, distance2, inverse, nearest2)
    sample.irradiance = wp.min(share * light.power, BRIGHTEST)
    return sample


@wp.func
def sample_directional(light: LightData, soft: int, u: wp.vec2) -> LightSample:
    """Samples a directional light: its direction or, if soft, a direction within its angular radius."""
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
        sample.pdf = 1.0 / wp.max(TWO_PI * edge, TINY)
    return sample


@wp.func
def is_flat(light: LightData) -> bool:
    """Returns whether a light is planar and one-sided (rectangle or disk)."""
    return light.kind == LIGHT_RECT or light.kind == LIGHT_DISK  # noqa: PLR1714


@wp.func
def flat_area(light: LightData) -> float:
    """Returns the area of a planar light."""
    if light.kind == LIGHT_DISK:
        return PI * light.radius * light.radius
    return wp.length(wp.cross(light.edge_u, light.edge_v))


@wp.func
def flat_point(light: LightData, u: wp.vec2) -> wp.vec3:
    """Returns a random point of a rectangle or disk light relative to its centre, uniform in area.

    ``u`` is random, 0..1 each.
    """
    if light.kind == LIGHT_DISK:
        return light.radius * wp.sqrt(u[0]) * around(light.direction, 0.0, 1.0, u[1])
    return (u[0] - 0.5) * light.edge_u + (u[1] - 0.5) * light.edge_v


@wp.func
def flat_covers(light: LightData, offset: wp.vec3) -> bool:
    """Returns whether a point in the plane of a planar light lies on the light.

    ``offset`` is the point relative to the light's centre.
    """
    if light.kind == LIGHT_DISK:
        return wp.dot(offset, offset) <= light.radius * light.radius
    across = wp.cross(light.edge_u, light.edge_v)
    area2 = wp.dot(across, across)
    u = wp.dot(wp.cross(offset, light.edge_v), across) / area2
    v = wp.dot(wp.cross(light.edge_u, offset), across) / area2
    return wp.max(wp.abs(u), wp.abs(v)) <= 0.5


@wp.func
def towards_flat(light: LightData, offset: wp.vec3, mirrored: wp.vec3) -> wp.vec3:
    """Returns the vector to the point of a planar light that is nearest, in its plane, to a ray along ``mirrored``.

    The ray starts at the origin, and ``offset`` is the centre of the light.
    """
    cosine = -wp.dot(mirrored, light.direction)
    t = -wp.dot(offset, light.direction) / wp.max(cosine, 1e-3)
    beside = t * mirrored - offset
    beside -= wp.dot(beside, light.direction) * light.direction
    if light.kind == LIGHT_DISK:
        return offset + wp.min(1.0, light.radius / wp.max(wp.length(beside), TINY)) * beside
    across = wp.cross(light.edge_u, light.edge_v)
    area2 = wp.max(wp.dot(across, across), TINY)
    u = wp.clamp(wp.dot(wp.cross(beside, light.edge_v), across) / area2, -0.5, 0.5)
    v = wp.clamp(wp.dot(wp.cross(light.edge_u, beside), across) / area2, -0.5, 0.5)
    return offset + u * light.edge_u + v * light.edge_v


@wp.func
def sample_flat(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """Samples a rectangle or disk light at its centre or, if soft, at a random point, uniform in area.

    At the centre, the sample carries the light of the whole area.
    """
    sample = LightSample()
    offset = light.position - point
    if soft != 0:
        offset += flat_point(light, u)
    distance2 = wp.dot(offset, offset)
    sample.distance = wp.sqrt(distance2)
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    if distance2 < TINY:
        return sample
    sample.direction = (1.0 / sample.distance) * offset
    cosine = -wp.dot(sample.direction, light.direction)
    if cosine <= 0.0:
        return sample
    solid_angle = wp.min(cosine * flat_area(light) / wp.max(distance2, NEAREST2), 1.0 / NEAREST2)
    if soft != 0:
        sample.pdf = 1.0 / wp.max(solid_angle, TINY)
    else:
        # A hard light gives no more irradiance than a whole hemisphere of its radiance.
        solid_angle = wp.min(solid_angle, PI)
    sample.irradiance = wp.min(solid_angle * light.power, BRIGHTEST)
    return sample


@wp.func
def sample_light(light: LightData, point: wp.vec3, soft: int, u: wp.vec2) -> LightSample:
    """Samples any light except the environment, as seen from ``point``.

    ``soft`` 0: the light is sampled at its centre; 1: at a point of its extent selected by ``u``, random, 0..1 each.
    """
    if light.kind == LIGHT_POINT or light.kind == LIGHT_SPOT:  # noqa: PLR1714
        return sample_point(light, point, soft, u)
    if light.kind == LIGHT_DIRECTIONAL:
        return sample_directional(light, soft, u)
    if is_flat(light):
        return sample_flat(light, point, soft, u)
    sample = LightSample()
    sample.direction = wp.vec3(0.0, 0.0, 1.0)
    if light.kind == LIGHT_HEADLIGHT:
        offset = light.position - point
        sample.distance = wp.length(offset)
        if sample.distance > 0.0:
            sample.direction = (1.0 / sample.distance) * offset
            sample.irradiance = light.power
    return sample


@wp.func
def flat_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Intersects a ray with the emitting side of a planar light."""
    crossing = LightCrossing()
    crossing.t = wp.inf
    cosine = -wp.dot(direction, light.direction)
    if cosine <= 0.0:
        return crossing
    t = wp.dot(origin - light.position, light.direction) / cosine
    offset = origin + t * direction - light.position
    if t > 0.0 and flat_covers(light, offset):
        crossing.t = t
        crossing.radiance = light.power
        crossing.pdf = wp.max(t * t, NEAREST2) / wp.max(cosine * flat_area(light), TINY)
    return crossing


@wp.func
def sphere_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Intersects a ray with a spherical light; the ray must start outside the sphere."""
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
        crossing.pdf = 1.0 / wp.max(TWO_PI * edge, TINY)
    return crossing


@wp.func
def light_crossing(light: LightData, origin: wp.vec3, direction: wp.vec3) -> LightCrossing:
    """Intersects a ray with a light's shape, a rectangle, disk or sphere.

    Returns distance, radiance, and the pdf with which sampling the light would choose the ray's direction.
    """
    if is_flat(light):
        return flat_crossing(light, origin, direction)
    return sphere_crossing(light, origin, direction)


@wp.func
def widest_cone(light: LightData, to_light: wp.vec3, distance: float, reach: float) -> float:
    """Returns an upper bound of a spot's angular attenuation, 0..1, at all points within ``reach`` of a given point.

    ``to_light`` is the vector from the given point to the spot, ``distance`` its length.
    """
    if distance <= reach:
        return 1.0
    off = to_light / distance + light.direction
    angle = 2.0 * wp.asin(wp.min(0.5 * wp.length(off), 1.0))
    sine = wp.sin(0.5 * wp.max(angle - wp.asin(reach / distance), 0.0))
    share = wp.clamp((light.outer - 2.0 * sine * sine) / wp.max(light.outer - light.inner, TINY), 0.0, 1.0)
    return share * share


@wp.func
def light_bound(light: LightData, center: wp.vec3, half: float) -> float:
    """Estimates the luminance of the irradiance by a light on surfaces, facing the light, within a cubic cell.

    ``half`` is half the cell's diagonal. The estimate is above 0 if any point of the cell receives light. The light
    must not be the environment.
    """
    power = wp.dot(WEIGHTS, light.power)
    if light.kind == LIGHT_DIRECTIONAL or light.kind == LIGHT_HEADLIGHT:  # noqa: PLR1714
        return power
    to_light = light.position - center
    distance = wp.length(to_light)
    reach = 2.0 * half
    nearest2 = wp.max(distance * distance, wp.max(half * half, TINY))
    if is_flat(light):
        height = reach - wp.dot(to_light, light.direction)
        if height <= 0.0:
            return 0.0
        cosine = wp.min(height / wp.sqrt(nearest2), 1.0)
        return power * wp.min(cosine * flat_area(light) / nearest2, PI)
    near = wp.max(distance - reach, 0.0)
    share = window(light, near * near)
    if light.kind == LIGHT_SPOT:
        share *= widest_cone(light, to_light, distance, reach)
    return share * power / nearest2
