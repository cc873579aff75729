"""Optical depth of Gaussians along rays from a light, in closed form (docs/method/deep_shadow_maps.md)."""

import math

import warp as wp

from lumisplat.constants import ALPHA_MAX, SHADOW_DEPTH_MIN, SHADOW_ERF_MAX
from lumisplat.device.gaussian.particle import canonical_from_object
from lumisplat.device.structs.shadow_map import PARALLEL, Atlas, Casters, DepthProfile, LightRay, Occluder

wp.set_module_options({"enable_backward": False})

SIMPLE: int = wp.constant(0)
AVERAGE: int = wp.constant(1)
MASS: int = wp.constant(2)

OPACITY_MAX = wp.constant(wp.float32(ALPHA_MAX))
DEPTH_MIN = wp.constant(wp.float32(SHADOW_DEPTH_MIN))
ERF_MAX = wp.constant(wp.float32(SHADOW_ERF_MAX))
SQRT_2_PI = wp.constant(wp.float32(math.sqrt(2.0 * math.pi)))


@wp.func
def absorption_of(mapping: int, strength: float, opacity: float, scale: wp.vec3) -> float:
    """Amplitude beta from opacity, with A the precision matrix in AVERAGE (docs/method/deep_shadow_maps.md#absorption).

    MASS stands for Mir et al.'s ``diag`` too: the root of the covariance's determinant is the product of the scales.
    """
    depth = -strength * wp.log(1.0 - wp.min(opacity, OPACITY_MAX))
    if mapping == AVERAGE:
        inverse = wp.vec3(1.0 / scale[0], 1.0 / scale[1], 1.0 / scale[2])
        return depth * wp.sqrt(wp.dot(inverse, inverse) / 3.0) / SQRT_2_PI
    if mapping == MASS:
        return depth / (SQRT_2_PI * scale[0]) / (SQRT_2_PI * scale[1]) / (SQRT_2_PI * scale[2])
    return depth


@wp.func
def reach_squared_of(absorption: float, scale: wp.vec3) -> float:
    """Squared canonical distance of a line from the mean at which its optical depth is negligible in any direction.

    Negative where it always is.
    """
    if absorption <= 0.0:
        return -1.0
    return 2.0 * wp.log(absorption * SQRT_2_PI * wp.max(scale) / DEPTH_MIN)


@wp.func
def occluder_of(atlas: Atlas, casters: Casters, i: int, mapping: int, strength: float) -> Occluder:
    """Caster ``i`` as seen from the light."""
    occluder = Occluder()
    scale = casters.scales[i]
    occluder.offset = casters.means[i] - atlas.origin
    occluder.canonical_from_world = canonical_from_object(casters.rotations[i], scale)
    occluder.absorption = absorption_of(mapping, strength, casters.opacities[i], scale)
    reach = wp.sqrt(wp.max(reach_squared_of(occluder.absorption, scale), 0.0)) * wp.max(scale)
    occluder.radius2 = reach * reach
    return occluder


@wp.func
def may_block(occluder: Occluder, ray: LightRay, light: wp.vec3) -> bool:
    """Whether a ray comes near enough to an occluder: a cheap test that most rays of a tile fail."""
    to_mean = occluder.offset - (ray.origin - light)
    nearest = wp.dot(to_mean, ray.direction)
    across = to_mean - nearest * ray.direction
    return wp.dot(across, across) <= occluder.radius2


@wp.func
def depth_profile(occluder: Occluder, ray: LightRay, light: wp.vec3) -> DepthProfile:
    """An occluder's optical depth along a ray, by docs/method/deep_shadow_maps.md#line-distance.

    The line's nearest point to the mean is found in the world first, then in canonical space, where the rest is small:
    no difference of large numbers is taken.
    """
    profile = DepthProfile()
    to_mean = occluder.offset - (ray.origin - light)
    nearest = wp.dot(to_mean, ray.direction)
    across = nearest * ray.direction - to_mean
    along = occluder.canonical_from_world * ray.direction
    start = occluder.canonical_from_world * across
    a = wp.dot(along, along)
    further = -wp.dot(start, along) / a
    miss = start + further * along
    profile.peak = nearest + further
    profile.sharpness = wp.sqrt(0.5 * a)
    profile.total = occluder.absorption * SQRT_2_PI / wp.sqrt(a) * wp.exp(-0.5 * wp.dot(miss, miss))
    return profile


@wp.func
def erf_between(low: float, high: float) -> float:
    """erf(high) - erf(low), for low <= high, with all digits also if both are near one."""
    if low > 0.0:
        return wp.erfc(low) - wp.erfc(high)
    if high < 0.0:
        return wp.erfc(-high) - wp.erfc(-low)
    return wp.erf(high) - wp.erf(low)


@wp.func
def depth_until(profile: DepthProfile, start: float, distance: float) -> float:
    """Optical depth from ``start``, the argument of the error function at which light starts, to a distance.

    Source: docs/method/deep_shadow_maps.md#optical-depth.
    """
    end = profile.sharpness * (distance - profile.peak)
    if start <= -ERF_MAX and end >= ERF_MAX:
        return profile.total
    return 0.5 * profile.total * erf_between(start, wp.max(end, start))


@wp.func
def start_of(atlas: Atlas, profile: DepthProfile) -> float:
    """The argument of the error function at which light starts; parallel light has no beginning."""
    if atlas.layout == PARALLEL:
        return -ERF_MAX
    return -profile.sharpness * profile.peak
