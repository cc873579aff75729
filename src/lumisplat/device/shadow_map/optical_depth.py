"""Closed-form optical depth of Gaussians along rays from a light, and the table of transmittances.

The equations are in docs/method/deep_shadow_maps.md#optical-depth.
"""

import math

import warp as wp

from lumisplat.constants import ALPHA_MAX
from lumisplat.device.gaussian.particle import canonical_from_object
from lumisplat.device.shadow_map.atlas import PARALLEL, TILE_TEXELS, Atlas, LightRay, atlas_from_world, texel_number
from lumisplat.device.structs import struct

SHADOW_DEPTH_MIN = 1e-6
"""A Gaussian is culled for rays on which its total optical depth is below this value.

A thousand ignored Gaussians change the transmittance by 0.001."""

SHADOW_ERF_MAX = 4.0
"""From this argument on, the error function counts as 1: erfc(4) is 1.5e-8, below float32's last digit."""


@struct
class Casters:
    """Gaussians that block light, world space, one element for each Gaussian."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Rotation from the Gaussian's axes to world space."""
    scales: wp.array[wp.vec3]
    """Standard deviations along the Gaussian's axes, scene units."""
    opacities: wp.array[float]


@struct
class Occluder:
    """A Gaussian that blocks light, prepared for optical depth (docs/method/deep_shadow_maps.md#optical-depth)."""

    offset: wp.vec3
    """Vector from ``Atlas.origin``, the light, to the Gaussian's mean, world space."""
    canonical_from_world: wp.mat33
    """Inverse of rotation times scale; the precision matrix A is this matrix's transpose times the matrix."""
    absorption: float
    """Absorption at the mean (amplitude beta), per scene unit; 0: the caster absorbs nothing."""
    radius2: float
    """Squared distance from the mean, scene units squared; rays that pass farther away have negligible optical depth.
    """


@struct
class DepthProfile:
    """Optical depth of one Gaussian along a light ray, as an error function of the distance."""

    total: float
    """Optical depth of the Gaussian along the infinite line of the ray."""
    peak: float
    """Distance along the ray at which the Gaussian absorbs most, scene units; negative: behind the light."""
    sharpness: float
    """``sqrt(a / 2)``, where a is the squared length of the ray's unit direction in canonical space; per scene unit."""


@struct
class Column:
    """The range of distance bins in which one texel stores transmittances."""

    first: int
    """Index of the first stored bin; nearer to the light, the texel is fully lit."""
    count: int
    """Number of stored bins; 0: the texel is lit at all distances."""
    offset: int
    """Index in ``Table.values`` of the transmittance of the first stored bin."""


@struct
class Table:
    """Contents of a deep shadow map: transmittance by texel and distance bin."""

    slots: wp.array[int]
    """For each tile of texels, the position of its columns in ``columns``, counted in tiles; -1: fully lit, no
    columns."""
    columns: wp.array[Column]
    """Stored range of bins of each texel, tile by tile, for tiles that are not fully lit."""
    values: wp.array[float]
    """Transmittance, 0..1, at the centre of each stored bin, texel by texel, away from the light."""


SIMPLE: int = wp.constant(0)

AVERAGE: int = wp.constant(1)

MASS: int = wp.constant(2)

OPACITY_MAX = wp.constant(wp.float32(ALPHA_MAX))

DEPTH_MIN = wp.constant(wp.float32(SHADOW_DEPTH_MIN))

ERF_MAX = wp.constant(wp.float32(SHADOW_ERF_MAX))

SQRT_2_PI = wp.constant(wp.float32(math.sqrt(2.0 * math.pi)))


@wp.func
def absorption_of(mapping: int, strength: float, opacity: float, scale: wp.vec3) -> float:
    """Returns beta, the absorption at a Gaussian's mean, per scene unit, for its opacity.

    d is the optical depth of the opacity, ``-strength log(1 - opacity)``. AVERAGE: a ray through the mean has optical
    depth d if the Gaussian's inverse standard deviation along the ray is the root mean square of its inverse scales
    (docs/method/deep_shadow_maps.md#absorption). MASS divides d by the Gaussian's volume, as Mir et al.'s ``diag``
    does. SIMPLE takes d itself.
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
    """Returns the squared distance from the mean, in standard deviations, from which optical depth is negligible.

    It holds for rays of any direction, and is negative if the optical depth is negligible on all rays.
    """
    if absorption <= 0.0:
        return -1.0
    return 2.0 * wp.log(absorption * SQRT_2_PI * wp.max(scale) / DEPTH_MIN)


@wp.func
def occluder_of(atlas: Atlas, casters: Casters, i: int, mapping: int, strength: float) -> Occluder:
    """Prepares caster ``i``, a Gaussian that blocks light, for optical depth along rays from the light."""
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
    """Returns whether a light ray passes a Gaussian closely enough to be darkened; ``light`` is ``Atlas.origin``.

    The test is cheap and rejects most rays of a tile.
    """
    to_mean = occluder.offset - (ray.origin - light)
    nearest = wp.dot(to_mean, ray.direction)
    across = to_mean - nearest * ray.direction
    return wp.dot(across, across) <= occluder.radius2


@wp.func
def depth_profile(occluder: Occluder, ray: LightRay, light: wp.vec3) -> DepthProfile:
    """Returns a Gaussian's optical depth along a light ray; ``light`` is ``Atlas.origin``.

    The line's nearest point to the mean is found in world space first, then in canonical space, where the remainder is
    small: no difference of large numbers is taken (docs/method/deep_shadow_maps.md#line-distance).
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
    """Returns erf(high) - erf(low), for low <= high, with full precision even if both values are near one."""
    if low > 0.0:
        return wp.erfc(low) - wp.erfc(high)
    if high < 0.0:
        return wp.erfc(-high) - wp.erfc(-low)
    return wp.erf(high) - wp.erf(low)


@wp.func
def depth_until(profile: DepthProfile, start: float, distance: float) -> float:
    """Returns the optical depth of a Gaussian on its ray from the light to ``distance``.

    ``start`` is the argument of the error function at the light (docs/method/deep_shadow_maps.md#optical-depth).
    """
    end = profile.sharpness * (distance - profile.peak)
    if start <= -ERF_MAX and end >= ERF_MAX:
        return profile.total
    return 0.5 * profile.total * erf_between(start, wp.max(end, start))


@wp.func
def start_of(atlas: Atlas, profile: DepthProfile) -> float:
    """Returns the argument of the error function at the light; parallel light starts infinitely far away."""
    if atlas.layout == PARALLEL:
        return -ERF_MAX
    return -profile.sharpness * profile.peak


# --- The table: columns of bins, filled with optical depths and read by interpolation ---


@wp.func
def bin_below(atlas: Atlas, distance: float) -> float:
    """Converts a distance from the light to a position in bins, whose centres are whole numbers.

    It is clamped to -1 and the last bin.
    """
    return wp.clamp(distance / atlas.bin_length - 0.5, -1.0, float(atlas.bins - 1))


@wp.func
def column_number(table: Table, texel: int) -> int:
    """Returns the index of a texel's column in ``Table.columns``; -1: its tile is fully lit, or ``texel`` is -1."""
    if texel < 0:
        return -1
    slot = table.slots[texel // TILE_TEXELS]
    return wp.where(slot < 0, -1, slot * TILE_TEXELS + texel % TILE_TEXELS)


@wp.func
def add_depths(atlas: Atlas, table: Table, column: Column, profile: DepthProfile):
    """Adds a Gaussian's optical depth along a ray to a texel's column: each bin gets the depth since the bin before.

    A prefix sum then gives the depth from the light. Bins behind the Gaussian gain nothing and are skipped.
    """
    begin = start_of(atlas, profile)
    width = ERF_MAX / profile.sharpness
    number = wp.max(int(wp.floor(bin_below(atlas, profile.peak - width))) + 1, column.first)
    before = float(0.0)
    passed = begin >= ERF_MAX
    while number < column.first + column.count and not passed:
        distance = (float(number) + 0.5) * atlas.bin_length
        depth = depth_until(profile, begin, distance)
        table.values[column.offset + number - column.first] += depth - before
        before = depth
        passed = distance >= profile.peak + width
        number += 1


@wp.func
def loss_in(table: Table, column: int, number: int) -> float:
    """Returns 1 - transmittance at the centre of bin ``number`` of a texel's column.

    It is 0 before the first stored bin and for ``column`` -1. Behind the last stored bin, it is that of the last bin,
    because lost light does not come back.
    """
    if column < 0 or table.columns[column].count == 0 or number < table.columns[column].first:
        return 0.0
    last = table.columns[column].count - 1
    return 1.0 - table.values[table.columns[column].offset + wp.min(number - table.columns[column].first, last)]


@wp.func
def loss_at(atlas: Atlas, table: Table, point: wp.vec3) -> float:
    """Returns 1 - transmittance from the light to a world-space point, trilinear between texels and bins.

    This loss is interpolated instead of the transmittance, so that a point without shadow gets exactly 0 despite
    rounding.
    """
    position = atlas_from_world(atlas, point)
    at = bin_below(atlas, position.distance)
    number = int(wp.floor(at))
    left = wp.floor(position.x)
    top = wp.floor(position.y)
    loss = float(0.0)
    for corner in range(4):
        x = corner % 2
        y = corner // 2
        column = column_number(table, texel_number(atlas, position.face, int(left) + x, int(top) + y))
        near = loss_in(table, column, number)
        far = loss_in(table, column, wp.min(number + 1, atlas.bins - 1))
        across = wp.where(x == 1, position.x - left, 1.0 - (position.x - left))
        down = wp.where(y == 1, position.y - top, 1.0 - (position.y - top))
        loss += across * down * wp.lerp(near, far, at - float(number))
    return loss
