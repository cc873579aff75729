"""Points at which receivers (Gaussians that light falls on) read a deep shadow map.

See docs/method/deep_shadow_maps.md#lookup.
"""

import math

import warp as wp

from lumisplat.constants import SHADOW_FOOTPRINT
from lumisplat.device.math.random import mix, pixel_key_of, sobol_2d
from lumisplat.device.shadow_map.atlas import EVERYTHING, NOTHING, PARALLEL, Atlas, parallel_direction
from lumisplat.device.structs import struct

SHADOW_TEXEL_ANGLE = 12.0
"""A lookup reads only texels within ``SHADOW_TEXEL_ANGLE / size`` radians of its direction; a face has size^2 texels.

Texels up to one texel diagonal away are read. A texel is 2 / size wide in octahedral coordinates, which stretch to at
most 3 radians per unit."""

SHADOW_STENCIL_WEIGHT = 0.6065306597126334
"""Weight of the STENCIL pattern's outer points relative to its centre: exp(-1/2), for one standard deviation."""

CENTER: int = wp.constant(0)

STENCIL: int = wp.constant(1)

RANDOM: int = wp.constant(2)


@struct
class Receivers:
    """Gaussians that light falls on, world space, at which the shadow map is read."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Rotation from the Gaussian's axes to world space."""
    scales: wp.array[wp.vec3]
    """Standard deviations along the Gaussian's axes, scene units; 0: a point."""


@struct
class ShadowBound:
    """Bound of all points that casters can darken: a cone from a point light, or a cylinder along parallel light."""

    extent: int
    """NOTHING: no point is in shadow. SOMETHING: only points within the bound may be. EVERYTHING: any point may be."""
    axis: wp.vec3
    """Point light: unit axis of the cone. Parallel light: a point on the cylinder's axis, relative to
    ``Atlas.origin``."""
    radius: float
    """Point light: half angle of the cone, radians. Parallel light: radius of the cylinder, scene units."""
    spread: float
    """Parallel light: growth of the radius per unit of distance from the light, the tangent of its angular radius."""


@struct
class FootprintSampling:
    """At which points within its extent a receiving Gaussian reads the shadow map."""

    pattern: int
    """CENTER: at the mean. STENCIL: also one standard deviation along each axis. RANDOM: normally distributed points.
    """
    count: int
    """Number of points at which each receiver reads the shadow map."""
    seed: wp.uint32


FOOTPRINT = wp.constant(wp.float32(SHADOW_FOOTPRINT))

OUTER_WEIGHT = wp.constant(wp.float32(SHADOW_STENCIL_WEIGHT))

TEXEL_ANGLE = wp.constant(wp.float32(SHADOW_TEXEL_ANGLE))

PI = wp.constant(wp.float32(math.pi))

SQRT_2 = wp.constant(wp.float32(math.sqrt(2.0)))

ERF_ARGUMENT_MAX = wp.constant(wp.float32(1.0 - 2.0**-23))


@wp.func
def normal_from_unit(u: float) -> float:
    """Returns x such that a standard normal random number is below x with probability ``u``, 0..1."""
    return SQRT_2 * wp.erfinv(wp.clamp(2.0 * u - 1.0, -ERF_ARGUMENT_MAX, ERF_ARGUMENT_MAX))


@wp.func
def sample_offset(sampling: FootprintSampling, receiver: int, sample: int) -> wp.vec3:
    """Returns the offset of sample ``sample`` from its receiver's mean, in standard deviations along its axes."""
    offset = wp.vec3(0.0)
    if sampling.pattern == STENCIL and sample > 0:
        offset[(sample - 1) // 2] = wp.where(sample % 2 == 1, 1.0, -1.0)
    if sampling.pattern == RANDOM:
        key = pixel_key_of(receiver, sampling.seed)
        u = sobol_2d(key, sample)
        w = sobol_2d(mix(key), sample)
        offset = wp.vec3(normal_from_unit(u[0]), normal_from_unit(u[1]), normal_from_unit(w[0]))
        # Clamped to the footprint's ellipsoid, because `may_be_shadowed` relies on samples not leaving it.
        offset = offset * (FOOTPRINT / wp.max(wp.length(offset), FOOTPRINT))
    return offset


@wp.func
def sample_weight(sampling: FootprintSampling, sample: int) -> float:
    """Returns the weight of sample ``sample`` of a receiver: 1 or, for outer STENCIL points, exp(-1/2).

    The weights are not normalised.
    """
    return wp.where(sampling.pattern == STENCIL and sample > 0, OUTER_WEIGHT, 1.0)


@wp.func
def sample_point(receivers: Receivers, sampling: FootprintSampling, receiver: int, sample: int) -> wp.vec3:
    """Returns the world-space position of sample ``sample`` of a receiver, as ``sample_offset`` gives it."""
    mean = receivers.means[receiver]
    if sampling.pattern == CENTER:
        return mean
    offset = wp.cw_mul(receivers.scales[receiver], sample_offset(sampling, receiver, sample))
    return mean + wp.quat_rotate(receivers.rotations[receiver], offset)


@wp.func
def may_be_shadowed(atlas: Atlas, bound: ShadowBound, receivers: Receivers, receiver: int) -> bool:
    """Returns whether any sample of a receiver may read a texel with shadow; False: the whole receiver is lit.

    The test is cheap and rejects most receivers.
    """
    if bound.extent == NOTHING:
        return False
    if bound.extent == EVERYTHING:
        return True
    offset = receivers.means[receiver] - atlas.origin
    radius = FOOTPRINT * wp.max(receivers.scales[receiver])
    if atlas.layout == PARALLEL:
        across = wp.cross(parallel_direction(atlas), offset - bound.axis)
        spread = bound.spread * wp.max(wp.dot(parallel_direction(atlas), offset) + radius, 0.0)
        return wp.length(across) <= bound.radius + radius + spread + 2.0 * atlas.texel_length
    distance = wp.length(offset)
    if distance <= radius:
        return True
    angle = bound.radius + wp.asin(radius / distance) + TEXEL_ANGLE / float(atlas.size)
    return angle >= PI or wp.dot(offset, bound.axis) >= wp.cos(angle) * distance
