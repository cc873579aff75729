"""Shadows of lights with an extent: rays from receivers to points of a light, through the depths of its shadow map.

See docs/method/deep_shadow_maps.md#lights-with-an-extent.
"""

import warp as wp

from lumisplat.device.math.directions import around
from lumisplat.device.math.random import mix, pixel_key_of, sobol_2d
from lumisplat.device.shadow_map.atlas import (
    PARALLEL,
    Atlas,
    AtlasPoint,
    atlas_from_direction,
    atlas_from_world,
    parallel_direction,
    texel_number,
)
from lumisplat.device.shadow_map.optical_depth import Table, bin_below, column_number
from lumisplat.device.structs import struct

SHADOW_STEPS = 32
"""Largest number of steps of a ray through a deep shadow map."""

SHADOW_STEP_TEXELS = 4.0
"""Texels that a ray through a deep shadow map crosses in each step, unless that takes more than ``SHADOW_STEPS``.

With 1 in place of 4, transmittances on the floor around a captured person are no closer to those of exact rays."""

SHADOW_DEPTH_MAX = 16.0
"""Optical depth at which a ray ends: exp(-16) is 1e-7."""

POINT: int = wp.constant(0)

ROUND: int = wp.constant(1)

DISK: int = wp.constant(2)

RECT: int = wp.constant(3)


@struct
class LightExtent:
    """Shape of a light that casts a shadow, and the distances from its centre between which casters are."""

    shape: int
    """POINT: no extent. ROUND: a sphere. DISK: a disk, or the visible disk of parallel light. RECT: a parallelogram."""
    radius: float
    """Largest distance of a point of the light from its centre, scene units. Parallel light: tangent of the angular
    radius."""
    first: wp.vec3
    """DISK: unit normal. RECT: first edge, scene units."""
    second: wp.vec3
    """RECT: second edge, scene units."""
    near: float
    """Distance from the light, scene units, up to which nothing is blocked."""
    far: float
    """Distance from the light, scene units, from which on nothing more is blocked."""


STEPS: int = wp.constant(SHADOW_STEPS)

STEP_TEXELS = wp.constant(wp.float32(SHADOW_STEP_TEXELS))

DEPTH_MAX = wp.constant(wp.float32(SHADOW_DEPTH_MAX))


@wp.func
def light_point(extent: LightExtent, receiver: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Returns a point of the light relative to its centre, uniform in area for uniform ``u`` in [0, 1).

    The point of a sphere is on the disk that ``receiver``, relative to the centre and outside of the sphere, sees.
    """
    if extent.shape == RECT:
        return (u[0] - 0.5) * extent.first + (u[1] - 0.5) * extent.second
    axis = extent.first
    radius = extent.radius * wp.sqrt(u[0])
    if extent.shape == ROUND:
        distance2 = wp.dot(receiver, receiver)
        axis = receiver / wp.sqrt(distance2)
        radius *= wp.sqrt(distance2 / (distance2 - extent.radius * extent.radius))
    return radius * around(axis, 0.0, 1.0, u[1])


@wp.func
def ray_point(atlas: Atlas, receiver: wp.vec3, light: wp.vec3, at: float) -> wp.vec3:
    """Returns a point between a receiver and a point of the light, all relative to ``Atlas.origin``.

    ``at`` 0 is the receiver; directions from a point light's centre change evenly with it, and so do positions in the
    plane of parallel light.
    """
    if atlas.layout == PARALLEL:
        return receiver + at * (light - parallel_direction(atlas))
    return (receiver + at * light) / (1.0 + at)


@wp.func
def texel_passed(atlas: Atlas, receiver: wp.vec3, light: wp.vec3, at: float, shift: wp.vec2) -> int:
    """Returns the index of the texel that ``ray_point`` passes, shifted by a part of a texel, 0..1; -1: none."""
    position = AtlasPoint()
    if atlas.layout == PARALLEL:
        position = atlas_from_world(atlas, atlas.origin + ray_point(atlas, receiver, light, at))
    else:
        position = atlas_from_direction(atlas, receiver + at * light)
    x = int(wp.floor(position.x + shift[0]))
    y = int(wp.floor(position.y + shift[1]))
    return texel_number(atlas, position.face, x, y)


@wp.func
def distance_of(atlas: Atlas, point: wp.vec3) -> float:
    """Returns the distance from the light of a point relative to ``Atlas.origin``."""
    if atlas.layout == PARALLEL:
        return wp.dot(point, parallel_direction(atlas))
    return wp.length(point)


@wp.func
def depth_in(atlas: Atlas, table: Table, column: int, distance: float) -> float:
    """Returns the optical depth from the light to ``distance`` in a texel's column, linear between bins.

    The table holds optical depths. In front of the first stored bin it is 0, behind the last one that of the last.
    """
    at = bin_below(atlas, distance)
    number = int(wp.floor(at))
    first = table.columns[column].first
    offset = table.columns[column].offset
    last = table.columns[column].count - 1
    if last < 0 or number + 1 < first:
        return 0.0
    far = table.values[offset + wp.min(number + 1 - first, last)]
    near = float(0.0)
    if number >= first:
        near = table.values[offset + wp.min(number - first, last)]
    return wp.lerp(near, far, at - float(number))


@wp.func
def texels_crossed(atlas: Atlas, start: wp.vec3, end: wp.vec3) -> float:
    """Returns about how many texels a ray crosses between two of its points, relative to ``Atlas.origin``."""
    if atlas.layout == PARALLEL:
        along = parallel_direction(atlas)
        return wp.length(wp.cross(along, end - start)) / atlas.texel_length
    return 0.5 * float(atlas.size) * wp.length(wp.normalize(end) - wp.normalize(start))


@wp.func
def loss_along(
    atlas: Atlas, table: Table, extent: LightExtent, point: wp.vec3, receiver: int, sample: int, seed: wp.uint32
) -> float:
    """Returns 1 - transmittance from a point of the light, drawn for sample ``sample`` of a receiver, to ``point``.

    Each step takes the optical depth that a texel's column gains between the distances of its ends, times the ratio of
    the ray's length to their difference. All steps are shifted by one random part of a texel: on average, that
    interpolates between texels.
    """
    offset = point - atlas.origin
    distance = distance_of(atlas, offset)
    start = wp.max(distance - extent.far, 0.0)
    end = distance - extent.near
    if atlas.layout != PARALLEL:
        start = wp.max(distance / extent.far - 1.0, 0.0)
        end = distance / extent.near - 1.0
    if end <= start:
        return 0.0
    key = mix(mix(pixel_key_of(receiver, seed)))
    light = light_point(extent, offset, sobol_2d(key, sample))
    shift = sobol_2d(mix(key), sample)
    crossed = texels_crossed(atlas, ray_point(atlas, offset, light, start), ray_point(atlas, offset, light, end))
    steps = wp.clamp(int(wp.ceil(crossed / STEP_TEXELS)), 1, STEPS)
    step = (end - start) / float(steps)
    depth = float(0.0)
    for k in range(steps):
        at = start + float(k) * step
        column = column_number(table, texel_passed(atlas, offset, light, at + 0.5 * step, shift))
        if column >= 0:
            before = ray_point(atlas, offset, light, at)
            after = ray_point(atlas, offset, light, at + step)
            outer = distance_of(atlas, before)
            inner = distance_of(atlas, after)
            if outer > inner:
                gain = depth_in(atlas, table, column, outer) - depth_in(atlas, table, column, inner)
                depth += gain * wp.length(after - before) / (outer - inner)
            if depth > DEPTH_MAX:
                return 1.0
    return 1.0 - wp.exp(-depth)
