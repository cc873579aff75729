"""Building and sampling deep shadow maps."""

import warp as wp

from lumisplat.constants import SHADOW_BOUND_MARGIN, SHADOW_BOUND_STEP
from lumisplat.device.shadow_map.atlas import PARALLEL, Atlas, place_of_point, ray_at, texel_number, texel_place
from lumisplat.device.shadow_map.lookup import bin_below, column_number, look_point, look_weight, loss_at, may_be_shaded
from lumisplat.device.shadow_map.optical_depth import (
    DEPTH_MIN,
    ERF_MAX,
    depth_until,
    footprint_of,
    may_block,
    meets,
    occluder_of,
    passage_of,
    start_of,
)
from lumisplat.device.structs.shadow_map import Casters, Cell, Footprint, Look, Occluder, Receivers, Shade, Table

# Functions that are not inlined clear all their locals first: in the innermost loops, that is most of the time.
wp.set_module_options(
    {
        "enable_backward": False,
        "cpu_compiler_flags": "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000",
    }
)

STEP = wp.constant(SHADOW_BOUND_STEP)
MARGIN = wp.constant(wp.float32(SHADOW_BOUND_MARGIN))


@wp.kernel
def prepare_occluders(
    start: int,
    atlas: Atlas,
    casters: Casters,
    mapping: int,
    strength: float,
    occluders_out: wp.array(dtype=Occluder),
    footprints_out: wp.array(dtype=Footprint),
):
    """One item is one caster."""
    i = start + wp.tid()
    occluder = occluder_of(atlas, casters, i, mapping, strength)
    occluders_out[i] = occluder
    footprints_out[i] = footprint_of(atlas, casters, i, occluder.absorption)


@wp.kernel
def bound_cells(start: int, atlas: Atlas, corners: wp.array(dtype=wp.vec3i), side: int, cells: wp.array(dtype=Cell)):
    """Cones around squares of ``side`` texels, by points of their edges. One item is one cell.

    ``corners`` are face, x and y of their first texels. What lies between two points of an edge that does not fold is
    on a great circle, and nearer to the axis than one of them.
    """
    i = start + wp.tid()
    face = corners[i][0]
    x = float(corners[i][1]) - 0.5
    y = float(corners[i][2]) - 0.5
    # The last cells of a face may reach beyond it, where an octahedral map folds back: they end with it.
    width = wp.min(float(side), float(atlas.size - corners[i][1]))
    height = wp.min(float(side), float(atlas.size - corners[i][2]))
    middle = ray_at(atlas, face, x + 0.5 * width, y + 0.5 * height)
    if atlas.layout == PARALLEL:
        cells[i].axis = middle.origin - atlas.origin
        cells[i].sine = 0.70710678 * float(side) * atlas.texel_length * (1.0 + MARGIN)
        return
    farthest = float(0.0)
    steps = side // STEP
    for k in range(4 * steps):
        along = float((k % steps) * STEP)
        edge = k // steps
        px = along
        py = float(0.0)
        if edge == 1:
            px = float(side)
            py = along
        if edge == 2:
            px = float(side) - along
            py = float(side)
        if edge == 3:
            px = float(0.0)
            py = float(side) - along
        direction = ray_at(atlas, face, x + wp.min(px, width), y + wp.min(py, height)).direction
        farthest = wp.max(farthest, wp.length(direction - middle.direction))
    cells[i].axis = middle.direction
    angle = 2.0 * wp.asin(wp.min(0.5 * farthest, 1.0)) * (1.0 + MARGIN) + MARGIN
    cells[i].cosine = wp.cos(angle)
    cells[i].sine = wp.sin(angle)


@wp.func
def span(ends: wp.array(dtype=int), i: int) -> wp.vec2i:
    """From where to where list ``i`` goes, by the ends of all lists."""
    return wp.vec2i(wp.where(i > 0, ends[wp.max(i - 1, 0)], 0), ends[i])


@wp.kernel
def count_met(
    start: int,
    atlas: Atlas,
    footprints: wp.array(dtype=Footprint),
    cells: wp.array(dtype=Cell),
    ends: wp.array(dtype=int),
    items: wp.array(dtype=int),
    counts_out: wp.array(dtype=int),
):
    """How many occluders of its parent's list a cell meets. One item is one cell."""
    i = start + wp.tid()
    cell = cells[i]
    among = span(ends, cell.parent)
    count = int(0)
    for k in range(among[0], among[1]):
        if meets(atlas, footprints[items[k]], cell):
            count += 1
    counts_out[i] = count


@wp.kernel
def list_met(
    start: int,
    atlas: Atlas,
    footprints: wp.array(dtype=Footprint),
    cells: wp.array(dtype=Cell),
    ends: wp.array(dtype=int),
    items: wp.array(dtype=int),
    ends_out: wp.array(dtype=int),
    items_out: wp.array(dtype=int),
):
    """Which ones, in order. One item is one cell."""
    i = start + wp.tid()
    cell = cells[i]
    among = span(ends, cell.parent)
    place = span(ends_out, i)[0]
    for k in range(among[0], among[1]):
        if meets(atlas, footprints[items[k]], cell):
            items_out[place] = items[k]
            place += 1


@wp.kernel
def tabulate(
    start: int,
    atlas: Atlas,
    culling: int,
    texels: wp.array(dtype=int),
    lists: wp.array(dtype=int),
    ends: wp.array(dtype=int),
    items: wp.array(dtype=int),
    occluders: wp.array(dtype=Occluder),
    table: Table,
):
    """Transmittances of a texel's column. One item is one of the ``texels`` that have one.

    The table first takes what each bin adds to the one before: a Gaussian that is passed costs nothing from there on.
    Source: docs/method/deep_shadow_maps.md#optical-depth.
    """
    i = start + wp.tid()
    column = table.columns[column_number(table, texels[i])]
    place = texel_place(atlas, texels[i])
    ray = ray_at(atlas, place[0], float(place[1]), float(place[2]))
    for k in range(column.count):
        table.values[column.offset + k] = 0.0
    among = span(ends, lists[i])
    for k in range(among[0], among[1]):
        if culling != 0 and not may_block(occluders[items[k]], ray, atlas.origin):
            continue
        passage = passage_of(occluders[items[k]], ray, atlas.origin)
        if culling == 0 or passage.depth >= DEPTH_MIN:
            begin = start_of(atlas, passage)
            width = ERF_MAX / passage.sharpness
            number = wp.max(int(wp.floor(bin_below(atlas, passage.peak - width))) + 1, column.first)
            before = float(0.0)
            passed = begin >= ERF_MAX
            while number < column.first + column.count and not passed:
                distance = (float(number) + 0.5) * atlas.bin_length
                depth = depth_until(passage, begin, distance)
                table.values[column.offset + number - column.first] += depth - before
                before = depth
                passed = distance >= passage.peak + width
                number += 1
    depth = float(0.0)
    for k in range(column.count):
        depth += table.values[column.offset + k]
        table.values[column.offset + k] = wp.exp(-wp.max(depth, 0.0))


@wp.kernel
def mark_looks(
    atlas: Atlas,
    receivers: Receivers,
    rows: wp.array(dtype=int),
    look: Look,
    firsts: wp.array(dtype=int),
    lasts: wp.array(dtype=int),
):
    """Widens the columns of texels to what some receivers look up. One item is one of ``rows``; not to be banded."""
    i = rows[wp.tid()]
    for sample in range(look.count):
        place = place_of_point(atlas, look_point(receivers, look, i, sample))
        number = int(wp.floor(bin_below(atlas, place.t)))
        for corner in range(4):
            x = int(wp.floor(place.x)) + corner % 2
            y = int(wp.floor(place.y)) + corner // 2
            texel = texel_number(atlas, place.face, x, y)
            if texel >= 0:
                wp.atomic_min(firsts, texel, wp.max(number, 0))
                wp.atomic_max(lasts, texel, wp.min(number + 1, atlas.bins - 1))


@wp.kernel
def look_up(
    start: int,
    atlas: Atlas,
    shade: Shade,
    table: Table,
    receivers: Receivers,
    look: Look,
    transmittance_out: wp.array(dtype=float),
):
    """What of the light reaches a receiver, averaged over the points where it looks. One item is one receiver."""
    i = start + wp.tid()
    transmittance_out[i] = 1.0
    if not may_be_shaded(atlas, shade, receivers, i):
        return
    total = float(0.0)
    weights = float(0.0)
    for sample in range(look.count):
        weight = look_weight(look, sample)
        point = look_point(receivers, look, i, sample)
        total += weight * loss_at(atlas, table, point)
        weights += weight
    transmittance_out[i] = wp.max(1.0 - total / weights, 0.0)
