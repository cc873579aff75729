"""The points at which receivers sample a deep shadow map (docs/method/deep_shadow_maps.md#lookup)."""

import math

import warp as wp

from lumisplat.constants import SHADOW_FOOTPRINT
from lumisplat.device.math.random import mix, pixel_key_of, sobol_2d
from lumisplat.device.shadow_map.atlas import EVERYTHING, NOTHING, PARALLEL, Atlas, parallel_direction
from lumisplat.device.structs import struct

SHADOW_TEXEL_ANGLE = 12.0
"""Radians, divided by the texels across a face, within which lookups find their texels: octahedral maps stretch up to 3
radians over a unit of two, and a lookup reads a texel's diagonal away."""

SHADOW_STENCIL_WEIGHT = 0.6065306597126334
"""Weight of the stencil's outer points, one standard deviation off, against the middle's 1: exp(-1/2)."""

CENTER: int = wp.constant(0)

STENCIL: int = wp.constant(1)

RANDOM: int = wp.constant(2)


@struct
class Receivers:
    """Gaussians that a shadow map is sampled for, world space."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """World from Gaussian."""
    scales: wp.array[wp.vec3]
    """Standard deviations; 0: a point."""


@struct
class ShadowBound:
    """A cone from the light, or for parallel light a cylinder, around all that casters can darken."""

    extent: int
    """NOTHING: no shadow. SOMETHING: within the bound below. EVERYTHING: not bounded."""
    axis: wp.vec3
    """Unit, of the cone; of the cylinder, a point on its axis, from the atlas's origin."""
    radius: float
    """Half the cone's angle, radians; of the cylinder, scene units."""


@struct
class FootprintSampling:
    """The points of a receiver's footprint at which the map is sampled."""

    pattern: int
    """CENTER, STENCIL or RANDOM."""
    count: int
    """Points a receiver."""
    seed: wp.uint32


FOOTPRINT = wp.constant(wp.float32(SHADOW_FOOTPRINT))

OUTER_WEIGHT = wp.constant(wp.float32(SHADOW_STENCIL_WEIGHT))

TEXEL_ANGLE = wp.constant(wp.float32(SHADOW_TEXEL_ANGLE))

PI = wp.constant(wp.float32(math.pi))

SQRT_2 = wp.constant(wp.float32(math.sqrt(2.0)))

ERF_ARGUMENT_MAX = wp.constant(wp.float32(1.0 - 2.0**-23))


@wp.func
def normal_from_unit(u: float) -> float:
    """The standard normal distribution's quantile of ``u``, 0..1."""
    return SQRT_2 * wp.erfinv(wp.clamp(2.0 * u - 1.0, -ERF_ARGUMENT_MAX, ERF_ARGUMENT_MAX))


@wp.func
def sample_offset(sampling: FootprintSampling, receiver: int, sample: int) -> wp.vec3:
    """A sample's offset from the mean of its receiver, in standard deviations along its axes."""
    offset = wp.vec3(0.0)
    if sampling.pattern == STENCIL and sample > 0:
        offset[(sample - 1) // 2] = wp.where(sample % 2 == 1, 1.0, -1.0)
    if sampling.pattern == RANDOM:
        key = pixel_key_of(receiver, sampling.seed)
        u = sobol_2d(key, sample)
        w = sobol_2d(mix(key), sample)
        offset = wp.vec3(normal_from_unit(u[0]), normal_from_unit(u[1]), normal_from_unit(w[0]))
        # Moved back onto the footprint's ellipsoid: `may_be_shadowed` relies on samples not to leave it.
        offset = offset * (FOOTPRINT / wp.max(wp.length(offset), FOOTPRINT))
    return offset


@wp.func
def sample_weight(sampling: FootprintSampling, sample: int) -> float:
    """Weight of a sample; weights are divided by their sum afterwards."""
    return wp.where(sampling.pattern == STENCIL and sample > 0, OUTER_WEIGHT, 1.0)


@wp.func
def sample_point(receivers: Receivers, sampling: FootprintSampling, receiver: int, sample: int) -> wp.vec3:
    """A sample's place, world space: x = mu + R (s * z)."""
    mean = receivers.means[receiver]
    if sampling.pattern == CENTER:
        return mean
    offset = wp.cw_mul(receivers.scales[receiver], sample_offset(sampling, receiver, sample))
    return mean + wp.quat_rotate(receivers.rotations[receiver], offset)


@wp.func
def may_be_shadowed(atlas: Atlas, bound: ShadowBound, receivers: Receivers, receiver: int) -> bool:
    """Whether a receiver's samples can read a texel that casters reach: a cheap test that most receivers fail."""
    if bound.extent == NOTHING:
        return False
    if bound.extent == EVERYTHING:
        return True
    offset = receivers.means[receiver] - atlas.origin
    radius = FOOTPRINT * wp.max(receivers.scales[receiver])
    if atlas.layout == PARALLEL:
        across = wp.cross(parallel_direction(atlas), offset - bound.axis)
        return wp.length(across) <= bound.radius + radius + 2.0 * atlas.texel_length
    distance = wp.length(offset)
    if distance <= radius:
        return True
    angle = bound.radius + wp.asin(radius / distance) + TEXEL_ANGLE / float(atlas.size)
    return angle >= PI or wp.dot(offset, bound.axis) >= wp.cos(angle) * distance
