"""Optical depth of Gaussians on rays from a light, in closed form, and where it is not negligible.

The equations are in docs/method/deep_shadow_maps.md.
"""

import math

import warp as wp

from lumisplat.constants import ALPHA_MAX, SHADOW_BOUND_MARGIN, SHADOW_DEPTH_MIN, SHADOW_ERF_MAX
from lumisplat.device.gaussian.particle import canonical_from_object
from lumisplat.device.math.directions import around
from lumisplat.device.shadow_map.atlas import PARALLEL, Atlas, LightRay
from lumisplat.device.structs.shadow_map import Casters, Cell, Footprint, Occluder, Passage

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(0)
SOMETHING = wp.constant(1)
EVERYTHING = wp.constant(2)

SIMPLE = wp.constant(0)
AVERAGE = wp.constant(1)
MASS = wp.constant(2)

OPACITY_MAX = wp.constant(wp.float32(ALPHA_MAX))
DEPTH_MIN = wp.constant(wp.float32(SHADOW_DEPTH_MIN))
ERF_MAX = wp.constant(wp.float32(SHADOW_ERF_MAX))
SQRT_2_PI = wp.constant(wp.float32(math.sqrt(2.0 * math.pi)))
MARGIN = wp.constant(wp.float32(SHADOW_BOUND_MARGIN))


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
    """Gaussian ``i`` as seen from the light."""
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
    """Whether a ray comes near enough to a Gaussian: a first look, which most rays of a tile end with."""
    to_mean = occluder.offset - (ray.origin - light)
    nearest = wp.dot(to_mean, ray.direction)
    across = to_mean - nearest * ray.direction
    return wp.dot(across, across) <= occluder.radius2


@wp.func
def passage_of(occluder: Occluder, ray: LightRay, light: wp.vec3) -> Passage:
    """A ray through a Gaussian, by docs/method/deep_shadow_maps.md#line-distance: no difference of large numbers.

    The line's nearest point to the mean is found in the world first, then in canonical space, where the rest is small.
    """
    passage = Passage()
    to_mean = occluder.offset - (ray.origin - light)
    nearest = wp.dot(to_mean, ray.direction)
    across = nearest * ray.direction - to_mean
    along = occluder.canonical_from_world * ray.direction
    start = occluder.canonical_from_world * across
    a = wp.dot(along, along)
    further = -wp.dot(start, along) / a
    miss = start + further * along
    passage.peak = nearest + further
    passage.sharpness = wp.sqrt(0.5 * a)
    passage.depth = occluder.absorption * SQRT_2_PI / wp.sqrt(a) * wp.exp(-0.5 * wp.dot(miss, miss))
    return passage


@wp.func
def erf_between(low: float, high: float) -> float:
    """erf(high) - erf(low), for low <= high, with all digits also where both are near one."""
    if low > 0.0:
        return wp.erfc(low) - wp.erfc(high)
    if high < 0.0:
        return wp.erfc(-high) - wp.erfc(-low)
    return wp.erf(high) - wp.erf(low)


@wp.func
def depth_until(passage: Passage, start: float, distance: float) -> float:
    """Optical depth of a Gaussian from ``start``, in units of its width from its peak, to a distance.

    Source: docs/method/deep_shadow_maps.md#optical-depth.
    """
    end = passage.sharpness * (distance - passage.peak)
    if start <= -ERF_MAX and end >= ERF_MAX:
        return passage.depth
    return 0.5 * passage.depth * erf_between(start, wp.max(end, start))


@wp.func
def start_of(atlas: Atlas, passage: Passage) -> float:
    """Where light starts, as for ``depth_until``: parallel light comes from behind everything."""
    if atlas.layout == PARALLEL:
        return -ERF_MAX
    return -passage.sharpness * passage.peak


@wp.func
def footprint_of(atlas: Atlas, casters: Casters, i: int, absorption: float) -> Footprint:
    """What Gaussian ``i`` covers: the ellipsoid outside which lines have negligible depth in it, seen from the light.

    The rectangle lies along the axes of the covariance across the light, and bounds the ellipsoid's perspective image
    exactly, by its dual quadric (docs/method/deep_shadow_maps.md#footprint).
    """
    footprint = Footprint()
    scale = casters.scales[i]
    reach2 = reach_squared_of(absorption, scale)
    if reach2 <= 0.0:
        return footprint
    footprint.extent = EVERYTHING
    offset = casters.means[i] - atlas.origin
    distance = wp.length(offset)
    reach = wp.sqrt(reach2) * wp.max(scale)
    direction = wp.vec3(atlas.axes[0, 2], atlas.axes[1, 2], atlas.axes[2, 2])
    if atlas.layout != PARALLEL:
        if distance <= reach * (1.0 + MARGIN):
            return footprint
        direction = offset / distance
    footprint.extent = SOMETHING
    footprint.direction = direction

    # The ellipsoid's axes, from the mean to where it ends, in the frame of the light's direction.
    spread = wp.sqrt(reach2) * (wp.quat_to_matrix(casters.rotations[i]) * wp.diag(scale))
    u = around(direction, 0.0, 1.0, 0.0)
    v = wp.cross(direction, u)
    along_u = wp.transpose(spread) * u
    along_v = wp.transpose(spread) * v
    turn = 0.5 * wp.atan2(2.0 * wp.dot(along_u, along_v), wp.dot(along_u, along_u) - wp.dot(along_v, along_v))
    footprint.first = wp.cos(turn) * u + wp.sin(turn) * v
    footprint.second = wp.cross(direction, footprint.first)
    first = wp.transpose(spread) * footprint.first
    second = wp.transpose(spread) * footprint.second
    half = wp.vec2(wp.length(first), wp.length(second)) * (1.0 + MARGIN)
    if atlas.layout == PARALLEL:
        middle = wp.vec2(wp.dot(offset, footprint.first), wp.dot(offset, footprint.second))
        margin = wp.vec2(MARGIN * atlas.texel_length)
        footprint.low = middle - half - margin
        footprint.high = middle + half + margin
        return footprint
    angle = wp.asin(reach / distance) + MARGIN
    footprint.cosine = wp.cos(angle)
    footprint.sine = wp.sin(angle)
    depth = wp.transpose(spread) * direction
    behind = distance * distance - wp.dot(depth, depth)
    skew = wp.vec2(wp.dot(first, depth), wp.dot(second, depth)) / behind
    width = wp.vec2(
        wp.sqrt(skew[0] * skew[0] + half[0] * half[0] / behind) + MARGIN * angle,
        wp.sqrt(skew[1] * skew[1] + half[1] * half[1] / behind) + MARGIN * angle,
    )
    footprint.low = -skew - width
    footprint.high = -skew + width
    return footprint


@wp.func
def overlaps(axis_cosine: float, forward: float, sine: float, low: float, high: float) -> bool:
    """Whether a cone's image in the plane at distance 1 reaches between two lines across one of the plane's axes.

    Args:
        axis_cosine: Of the cone's axis with that axis of the plane.
        forward: Of the cone's axis with the plane's normal, above ``sine``.
        sine: Of half the cone's angle.
        low: Where the first line is.
        high: Where the second is.
    """
    behind = forward * forward - sine * sine
    middle = axis_cosine * forward / behind
    width = sine * wp.sqrt(wp.max(axis_cosine * axis_cosine + behind, 0.0)) / behind
    return middle - width <= high and middle + width >= low


@wp.func
def meets(atlas: Atlas, footprint: Footprint, cell: Cell) -> bool:
    """Whether a ray through a cell may have more than negligible depth in a Gaussian; never False where one has."""
    if footprint.extent != SOMETHING:
        return footprint.extent == EVERYTHING
    forward = wp.dot(cell.axis, footprint.direction)
    # The axes are farther apart than the two half angles together; by cosines, as most pairs end here.
    if atlas.layout != PARALLEL and (
        cell.cosine >= 0.0 and forward < cell.cosine * footprint.cosine - cell.sine * footprint.sine
    ):
        return False
    across = wp.dot(cell.axis, footprint.first)
    down = wp.dot(cell.axis, footprint.second)
    if atlas.layout == PARALLEL:
        r = cell.sine
        low = footprint.low
        high = footprint.high
        return across - r <= high[0] and across + r >= low[0] and down - r <= high[1] and down + r >= low[1]
    if cell.cosine < 0.0 or forward <= cell.sine:
        return True
    return overlaps(across, forward, cell.sine, footprint.low[0], footprint.high[0]) and overlaps(
        down, forward, cell.sine, footprint.low[1], footprint.high[1]
    )
