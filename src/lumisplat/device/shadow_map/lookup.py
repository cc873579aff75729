"""Lookups in a deep shadow map, at a point and over a receiver's footprint (docs/method/deep_shadow_maps.md#lookup)."""

import math

import warp as wp

from lumisplat.constants import SHADOW_FOOTPRINT, SHADOW_STENCIL_WEIGHT, SHADOW_TEXEL_ANGLE
from lumisplat.device.math.random import mix, pixel_key_of, sobol_2d
from lumisplat.device.shadow_map.atlas import PARALLEL, TILE_TEXELS, Atlas, place_of_point, texel_number
from lumisplat.device.structs.shadow_map import Look, Receivers, Shade, Table

wp.set_module_options({"enable_backward": False})

CENTER = wp.constant(0)
STENCIL = wp.constant(1)
RANDOM = wp.constant(2)

FOOTPRINT = wp.constant(wp.float32(SHADOW_FOOTPRINT))
OUTER_WEIGHT = wp.constant(wp.float32(SHADOW_STENCIL_WEIGHT))
TEXEL_ANGLE = wp.constant(wp.float32(SHADOW_TEXEL_ANGLE))
PI = wp.constant(wp.float32(math.pi))
SQRT_2 = wp.constant(wp.float32(math.sqrt(2.0)))
ERF_ARGUMENT_MAX = wp.constant(wp.float32(1.0 - 2.0**-23))


@wp.func
def normal_from_unit(u: float) -> float:
    """The standard normal number that a share ``u`` of all is below."""
    return SQRT_2 * wp.erfinv(wp.clamp(2.0 * u - 1.0, -ERF_ARGUMENT_MAX, ERF_ARGUMENT_MAX))


@wp.func
def look_offset(look: Look, receiver: int, sample: int) -> wp.vec3:
    """Where a receiver looks, in standard deviations along its axes."""
    offset = wp.vec3(0.0)
    if look.pattern == STENCIL and sample > 0:
        offset[(sample - 1) // 2] = wp.where(sample % 2 == 1, 1.0, -1.0)
    if look.pattern == RANDOM:
        key = pixel_key_of(receiver, look.seed)
        u = sobol_2d(key, sample)
        w = sobol_2d(mix(key), sample)
        offset = wp.vec3(normal_from_unit(u[0]), normal_from_unit(u[1]), normal_from_unit(w[0]))
        # Cut at the footprint's end, as an ellipsoid: what is taken to be out of reach must be.
        offset = offset * (FOOTPRINT / wp.max(wp.length(offset), FOOTPRINT))
    return offset


@wp.func
def look_weight(look: Look, sample: int) -> float:
    """What a point counts, before weights are divided by their sum."""
    return wp.where(look.pattern == STENCIL and sample > 0, OUTER_WEIGHT, 1.0)


@wp.func
def look_point(receivers: Receivers, look: Look, receiver: int, sample: int) -> wp.vec3:
    """Where a receiver looks, world space: x = mu + R (s * z)."""
    mean = receivers.means[receiver]
    if look.pattern == CENTER:
        return mean
    offset = wp.cw_mul(receivers.scales[receiver], look_offset(look, receiver, sample))
    return mean + wp.quat_rotate(receivers.rotations[receiver], offset)


@wp.func
def may_be_shaded(atlas: Atlas, shade: Shade, receivers: Receivers, receiver: int) -> bool:
    """Whether a receiver looks at any texel that casters reach: a first look, which most end with."""
    offset = receivers.means[receiver] - atlas.origin
    radius = FOOTPRINT * wp.max(receivers.scales[receiver])
    if atlas.layout == PARALLEL:
        along = wp.vec3(atlas.axes[0, 2], atlas.axes[1, 2], atlas.axes[2, 2])
        across = wp.cross(along, offset - shade.axis)
        return wp.length(across) <= shade.radius + radius + 2.0 * atlas.texel_length
    distance = wp.length(offset)
    if distance <= radius:
        return True
    angle = shade.radius + wp.asin(radius / distance) + TEXEL_ANGLE / float(atlas.size)
    return angle >= PI or wp.dot(offset, shade.axis) >= wp.cos(angle) * distance


@wp.func
def bin_below(atlas: Atlas, t: float) -> float:
    """Where a distance is among the bins, whose centres are whole numbers; none is below -1 or above the last."""
    return wp.clamp(t / atlas.bin_length - 0.5, -1.0, float(atlas.bins - 1))


@wp.func
def column_number(table: Table, texel: int) -> int:
    """Where the column of a texel is; -1: nowhere."""
    if texel < 0:
        return -1
    slot = table.slots[texel // TILE_TEXELS]
    return wp.where(slot < 0, -1, slot * TILE_TEXELS + texel % TILE_TEXELS)


@wp.func
def loss_in(table: Table, i: int, number: int) -> float:
    """Share of the light that is lost at a bin's centre, by column. Nothing is before a column begins, or without one.

    Behind its last bin it is as there: light that was lost does not come back.
    """
    if i < 0 or table.columns[i].count == 0 or number < table.columns[i].first:
        return 0.0
    last = table.columns[i].count - 1
    return 1.0 - table.values[table.columns[i].offset + wp.min(number - table.columns[i].first, last)]


@wp.func
def loss_at(atlas: Atlas, table: Table, point: wp.vec3) -> float:
    """Share of the light that is lost on the way to a point: trilinear between the nearest texels and bins.

    Of what is lost, not of what arrives: where nothing is in the way, weights whose sum is rounded do not matter.
    """
    place = place_of_point(atlas, point)
    at = bin_below(atlas, place.t)
    number = int(wp.floor(at))
    left = wp.floor(place.x)
    top = wp.floor(place.y)
    loss = float(0.0)
    for corner in range(4):
        x = corner % 2
        y = corner // 2
        i = column_number(table, texel_number(atlas, place.face, int(left) + x, int(top) + y))
        near = loss_in(table, i, number)
        far = loss_in(table, i, wp.min(number + 1, atlas.bins - 1))
        across = wp.where(x == 1, place.x - left, 1.0 - (place.x - left))
        down = wp.where(y == 1, place.y - top, 1.0 - (place.y - top))
        loss += across * down * wp.lerp(near, far, at - float(number))
    return loss
