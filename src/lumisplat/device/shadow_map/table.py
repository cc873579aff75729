"""The table of a deep shadow map: columns of bins, written by depths and read by interpolation."""

import warp as wp

from lumisplat.device.shadow_map.atlas import TILE_TEXELS, atlas_from_world, texel_number
from lumisplat.device.shadow_map.optical_depth import ERF_MAX, depth_until, start_of
from lumisplat.device.structs.shadow_map import Atlas, Column, DepthProfile, Table

wp.set_module_options({"enable_backward": False})


@wp.func
def bin_below(atlas: Atlas, distance: float) -> float:
    """A distance in bins, whose centres are whole numbers, clamped to -1 and the last bin."""
    return wp.clamp(distance / atlas.bin_length - 0.5, -1.0, float(atlas.bins - 1))


@wp.func
def column_number(table: Table, texel: int) -> int:
    """The number of a texel's column; -1: it has none."""
    if texel < 0:
        return -1
    slot = table.slots[texel // TILE_TEXELS]
    return wp.where(slot < 0, -1, slot * TILE_TEXELS + texel % TILE_TEXELS)


@wp.func
def add_depths(atlas: Atlas, table: Table, column: Column, profile: DepthProfile):
    """Adds to each bin of a column the optical depth of an occluder that lies between it and the bin before.

    An occluder adds nothing to the bins behind it, which are skipped.
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
    """Share of the light that is lost at the centre of bin ``number`` of a column: 0 before the first, or without one.

    Behind the last bin it is as there: light that was lost does not come back.
    """
    if column < 0 or table.columns[column].count == 0 or number < table.columns[column].first:
        return 0.0
    last = table.columns[column].count - 1
    return 1.0 - table.values[table.columns[column].offset + wp.min(number - table.columns[column].first, last)]


@wp.func
def loss_at(atlas: Atlas, table: Table, point: wp.vec3) -> float:
    """Share of the light that is lost on the way to a point: trilinear between the nearest texels and bins.

    The loss is interpolated, not the transmittance: an unblocked receiver gets exactly 0, however weights are rounded.
    """
    place = atlas_from_world(atlas, point)
    at = bin_below(atlas, place.distance)
    number = int(wp.floor(at))
    left = wp.floor(place.x)
    top = wp.floor(place.y)
    loss = float(0.0)
    for corner in range(4):
        x = corner % 2
        y = corner // 2
        column = column_number(table, texel_number(atlas, place.face, int(left) + x, int(top) + y))
        near = loss_in(table, column, number)
        far = loss_in(table, column, wp.min(number + 1, atlas.bins - 1))
        across = wp.where(x == 1, place.x - left, 1.0 - (place.x - left))
        down = wp.where(y == 1, place.y - top, 1.0 - (place.y - top))
        loss += across * down * wp.lerp(near, far, at - float(number))
    return loss
