"""Kernels that build and sample deep shadow maps."""

import warp as wp

from lumisplat.constants import FUSED_FLAGS
from lumisplat.device.shadow_map.atlas import Atlas, atlas_from_world, ray_through, texel_coordinates, texel_number
from lumisplat.device.shadow_map.culling import (
    CasterLists,
    Cell,
    Footprint,
    bounded_cell,
    footprint_of,
    list_begin,
    may_intersect,
    part_of_list,
)
from lumisplat.device.shadow_map.light_extent import LightExtent, loss_along
from lumisplat.device.shadow_map.lookup import (
    RANDOM,
    FootprintSampling,
    Receivers,
    ShadowBound,
    may_be_shadowed,
    sample_point,
    sample_weight,
)
from lumisplat.device.shadow_map.optical_depth import (
    DEPTH_MIN,
    Casters,
    Occluder,
    Table,
    add_depths,
    bin_below,
    column_number,
    depth_profile,
    loss_at,
    may_block,
    occluder_of,
)

SHADOW_CLEAR = 1e-4
"""Mean loss, or mean transmittance, of its first rays below which a receiver counts as wholly lit, or in the umbra."""

CLEAR = wp.constant(wp.float32(SHADOW_CLEAR))

# Functions that are not inlined clear all their locals first, which dominates the innermost loops.
wp.set_module_options(
    {
        "enable_backward": False,
        "cpu_compiler_flags": FUSED_FLAGS,
    }
)


@wp.kernel
def prepare_occluders(
    start: int,
    atlas: Atlas,
    casters: Casters,
    mapping: int,
    strength: float,
    occluders_out: wp.array[Occluder],
    footprints_out: wp.array[Footprint],
):
    """Computes each caster's absorption and footprint as the light sees them. One thread per caster."""
    i = start + wp.tid()
    occluder = occluder_of(atlas, casters, i, mapping, strength)
    occluders_out[i] = occluder
    footprints_out[i] = footprint_of(atlas, casters, i, occluder.absorption)


@wp.kernel
def bound_cells(
    start: int,
    atlas: Atlas,
    corners: wp.array[wp.vec3i],
    side: int,
    parents: wp.array[int],
    cells_out: wp.array[Cell],
):
    """Bounds the light rays through a cell (square of ``side`` texels). One thread per cell.

    ``corners`` holds face, column and row of each square's first texel, and ``parents`` the caster list of the larger
    square that contains it.
    """
    i = start + wp.tid()
    cells_out[i] = bounded_cell(atlas, corners[i], side, parents[i])


@wp.kernel
def count_intersections(
    start: int,
    atlas: Atlas,
    footprints: wp.array[Footprint],
    cells: wp.array[Cell],
    lists: CasterLists,
    parts: int,
    counts_out: wp.array[int],
):
    """Counts the casters that rays through a cell may intersect, among those of the larger square around the cell.

    The list of the larger square is split into ``parts``; one thread per part of one cell's list.
    """
    i = start + wp.tid()
    cell = cells[i // parts]
    begin, end = part_of_list(lists, cell.parent, i % parts, parts)
    count = int(0)
    for k in range(begin, end):
        if may_intersect(atlas, footprints[lists.items[k]], cell):
            count += 1
    counts_out[i] = count


@wp.kernel
def list_intersections(
    start: int,
    atlas: Atlas,
    footprints: wp.array[Footprint],
    cells: wp.array[Cell],
    lists: CasterLists,
    parts: int,
    ends: wp.array[int],
    items_out: wp.array[int],
):
    """Lists the casters that `count_intersections` counted, in order. One thread per part of one cell's list.

    ``ends`` holds the end of each thread's entries in ``items_out``.
    """
    i = start + wp.tid()
    cell = cells[i // parts]
    begin, end = part_of_list(lists, cell.parent, i % parts, parts)
    slot = int(0)
    if i > 0:
        slot = ends[i - 1]
    for k in range(begin, end):
        if may_intersect(atlas, footprints[lists.items[k]], cell):
            items_out[slot] = lists.items[k]
            slot += 1


@wp.kernel
def tabulate(
    start: int,
    atlas: Atlas,
    culling: bool,
    as_depths: bool,
    texels: wp.array[int],
    list_of_texel: wp.array[int],
    lists: CasterLists,
    occluders: wp.array[Occluder],
    table: Table,
):
    """Tabulates the transmittance of a texel's column of depth bins. One thread per element of ``texels``.

    The table first holds the optical depth that each bin adds to the previous bin's, then their sum up to each bin if
    ``as_depths``, else exp(-sum). Source: docs/method/deep_shadow_maps.md#optical-depth.
    """
    i = start + wp.tid()
    column = table.columns[column_number(table, texels[i])]
    coordinates = texel_coordinates(atlas, texels[i])
    ray = ray_through(atlas, coordinates[0], float(coordinates[1]), float(coordinates[2]))
    for k in range(column.count):
        table.values[column.offset + k] = 0.0
    for k in range(list_begin(lists, list_of_texel[i]), lists.ends[list_of_texel[i]]):
        caster = lists.items[k]
        if culling and not may_block(occluders[caster], ray, atlas.origin):
            continue
        profile = depth_profile(occluders[caster], ray, atlas.origin)
        if not culling or profile.total >= DEPTH_MIN:
            add_depths(atlas, table, column, profile)
    depth = float(0.0)
    for k in range(column.count):
        depth += table.values[column.offset + k]
        if as_depths:
            table.values[column.offset + k] = wp.max(depth, 0.0)
        else:
            table.values[column.offset + k] = wp.exp(-wp.max(depth, 0.0))


@wp.kernel
def mark_bins(
    atlas: Atlas,
    receivers: Receivers,
    rows: wp.array[int],
    sampling: FootprintSampling,
    firsts: wp.array[int],
    lasts: wp.array[int],
):
    """Extends texels' columns to the bins that lookups of a receiver read. One thread per element of ``rows``.

    Not to be split over CPU threads, because several items write to one column by atomics.
    """
    i = rows[wp.tid()]
    for sample in range(sampling.count):
        lookup = atlas_from_world(atlas, sample_point(receivers, sampling, i, sample))
        number = int(wp.floor(bin_below(atlas, lookup.distance)))
        for corner in range(4):
            x = int(wp.floor(lookup.x)) + corner % 2
            y = int(wp.floor(lookup.y)) + corner // 2
            texel = texel_number(atlas, lookup.face, x, y)
            if texel >= 0:
                wp.atomic_min(firsts, texel, wp.max(number, 0))
                wp.atomic_max(lasts, texel, wp.min(number + 1, atlas.bins - 1))


@wp.kernel
def average_transmittance(
    start: int,
    atlas: Atlas,
    bound: ShadowBound,
    table: Table,
    receivers: Receivers,
    sampling: FootprintSampling,
    transmittance_out: wp.array[float],
):
    """Computes the mean transmittance over the samples in a receiver's footprint. One thread per receiver."""
    i = start + wp.tid()
    transmittance_out[i] = 1.0
    if not may_be_shadowed(atlas, bound, receivers, i):
        return
    loss = float(0.0)
    weights = float(0.0)
    for sample in range(sampling.count):
        weight = sample_weight(sampling, sample)
        loss += weight * loss_at(atlas, table, sample_point(receivers, sampling, i, sample))
        weights += weight
    transmittance_out[i] = wp.max(1.0 - loss / weights, 0.0)


@wp.kernel
def average_soft_transmittance(
    start: int,
    atlas: Atlas,
    bound: ShadowBound,
    table: Table,
    receivers: Receivers,
    sampling: FootprintSampling,
    extent: LightExtent,
    rays: int,
    transmittance_out: wp.array[float],
):
    """Computes the mean transmittance over ``rays`` rays from a receiver's footprint to points of the light.

    Where the first quarter of the rays, at least ``sampling.count``, are all lit or all blocked, the others are
    omitted. One thread per receiver.
    """
    i = start + wp.tid()
    transmittance_out[i] = 1.0
    if not may_be_shadowed(atlas, bound, receivers, i):
        return
    loss = float(0.0)
    weights = float(0.0)
    first = wp.max(rays // 4, sampling.count)
    for ray in range(rays):
        if ray == first and (loss <= CLEAR * weights or loss >= (1.0 - CLEAR) * weights):
            break
        sample = ray
        if sampling.pattern != RANDOM:
            sample = ray % sampling.count
        weight = sample_weight(sampling, sample)
        point = sample_point(receivers, sampling, i, sample)
        loss += weight * loss_along(atlas, table, extent, point, i, ray, sampling.seed)
        weights += weight
    transmittance_out[i] = wp.max(1.0 - loss / weights, 0.0)
