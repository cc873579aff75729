"""Kernels of the radiance cache: samples sorted into cells, light between cells, and tiles that come and go.

All are write-once: of the sorted samples of a cell, or of a tile, the first one does the work of all. Tiles are sorted
keys into which new ones are merged, and out of which old ones are removed (docs/method/realtime.md#radiance-cache).
"""

import warp as wp

from lumisplat.device.gi.radiance_cache import (
    AGE_LAST,
    COUNT_DROPPED,
    COUNT_EVICTED,
    COUNT_EXCESS,
    COUNT_LIVE,
    COUNT_NEW,
    COUNTS,
    NO_TILE,
    TILE_CELLS,
    TILE_MEANS,
    TILE_MIPS,
    CacheGrid,
    CachePoints,
    CacheSamples,
    CacheTiles,
    CellLight,
    SortedSamples,
    cached_radiance,
    cell_key,
    cell_of_sample,
    color_of,
    far_radiance,
    is_first_of_cell,
    is_first_of_tile,
    is_of_short_rays,
    level_of,
    mean_index,
    slot_of,
)
from lumisplat.device.gi.surfaces import mean_weight
from lumisplat.device.math.random import mix
from lumisplat.device.math.sorting import first_not_below

wp.set_module_options({"enable_backward": False})

CELL_RAYS_MAX = 16
"""Rays that a cell of long rays sends in a frame at most, where few cells share those of a frame."""

RAYS_MAX = wp.constant(CELL_RAYS_MAX)


@wp.kernel
def find_cells(
    start: int,
    grid: CacheGrid,
    samples: CacheSamples,
    keys_out: wp.array[wp.int64],
    cells_out: wp.array[int],
    sort_cells_out: wp.array[int],
    order_out: wp.array[int],
):
    """Item = sample: its tile and cell; none if it is not finite."""
    i = start + wp.tid()
    keys_out[i] = NO_TILE
    cells_out[i] = 0
    sort_cells_out[i] = 0
    order_out[i] = i
    if samples.is_active[i]:
        if wp.isfinite(samples.radiance[i]) and wp.isfinite(samples.from_eye[i]):
            address = cell_of_sample(grid, samples, i)
            keys_out[i] = address.key
            cells_out[i] = address.cell
            sort_cells_out[i] = address.cell


@wp.kernel
def gather_keys(start: int, keys: wp.array[wp.int64], order: wp.array[int], keys_out: wp.array[wp.int64]):
    """Keys of samples in an order."""
    i = start + wp.tid()
    keys_out[i] = keys[order[i]]


@wp.func
def mean_with(mean: wp.vec4, weight: float, total: wp.vec3d, count: int) -> wp.vec4:
    """A mean that counts for ``weight`` samples, with a further ``count`` of them that sum to ``total``."""
    before = wp.float64(weight)
    all = before + wp.float64(count)
    color = (wp.vec3d(color_of(mean)) * before + total) / all
    return wp.vec4(float(color[0]), float(color[1]), float(color[2]), float(all))


@wp.kernel
def add_samples(
    start: int, frame: int, grid: CacheGrid, samples: CacheSamples, sorted_samples: SortedSamples, tiles: CacheTiles
):
    """Adds the samples of each cell to its mean, and stores one of them, at random, as the origin of its bounce."""
    i = start + wp.tid()
    if not is_first_of_cell(sorted_samples, i):
        return
    key = sorted_samples.keys[i]
    slot = slot_of(tiles, key)
    if slot < 0:
        return
    cell = sorted_samples.cells[sorted_samples.order[i]]
    total = wp.vec3d()
    end = int(i)
    while end < samples.is_active.shape[0] and (end == i or not is_first_of_cell(sorted_samples, end)):
        if sorted_samples.keys[end] == NO_TILE:
            break
        total += wp.vec3d(samples.radiance[sorted_samples.order[end]])
        end += 1
    at = slot * TILE_CELLS + cell
    mean = tiles.direct[slot * TILE_MEANS + cell]
    weight = mean[3]
    if tiles.frames[at] == 0 or tiles.updated[at] != frame:
        if float(tiles.frames[at]) >= grid.history:
            weight *= 1.0 - 1.0 / grid.history
        else:
            tiles.frames[at] = tiles.frames[at] + 1
    tiles.updated[at] = frame
    tiles.direct[slot * TILE_MEANS + cell] = mean_with(mean, weight, total, end - i)
    drawn = int(mix(cell_key(key, cell, frame)) % wp.uint32(end - i))
    chosen = sorted_samples.order[i + drawn]
    tiles.position[at] = samples.position[chosen]
    tiles.normal[at] = samples.normal[chosen]
    tiles.extent[at] = samples.extent[chosen]


@wp.func
def average_mips(means: wp.array[wp.vec4], slot: int):
    """Means of a tile over squares of cells, each from the four of half its width, by their samples."""
    for mip in range(1, TILE_MIPS):
        side = 8 >> mip
        for square in range(side * side):
            corner = ((square // side) * 8 + square % side) << mip
            total = wp.vec3d()
            weight = wp.float64(0.0)
            for quarter in range(4):
                cell = corner + (((quarter >> 1) * 8 + (quarter & 1)) << (mip - 1))
                mean = means[mean_index(slot, cell, mip - 1)]
                total += wp.vec3d(color_of(mean)) * wp.float64(mean[3])
                weight += wp.float64(mean[3])
            color = total / wp.max(weight, wp.float64(1e-30))
            means[mean_index(slot, corner, mip)] = wp.vec4(
                float(color[0]), float(color[1]), float(color[2]), float(weight)
            )


@wp.kernel
def update_tiles(start: int, samples: SortedSamples, tiles: CacheTiles):
    """Means over squares of the tiles that samples have gone into, and how many of their cells have some."""
    i = start + wp.tid()
    if is_first_of_tile(samples, i):
        slot = slot_of(tiles, samples.keys[i])
        if slot >= 0:
            filled = int(0)
            for cell in range(TILE_CELLS):
                filled += wp.min(tiles.frames[slot * TILE_CELLS + cell], 1)
            tiles.filled[slot] = filled
            average_mips(tiles.direct, slot)


@wp.kernel
def outdate_means(start: int, share: float, tiles: CacheTiles):
    """Item = mean of a tile: lowers its weight to a share, in samples and in frames."""
    i = start + wp.tid()
    tile = i // TILE_MEANS
    if tile >= tiles.counts[COUNT_LIVE]:
        return
    within = i - tile * TILE_MEANS
    slot = tiles.slots[tile]
    at = slot * TILE_MEANS + within
    tiles.direct[at][3] = share * tiles.direct[at][3]
    tiles.indirect[at][3] = share * tiles.indirect[at][3]
    if within < TILE_CELLS:
        frames = tiles.frames[slot * TILE_CELLS + within]
        tiles.frames[slot * TILE_CELLS + within] = wp.min(frames, wp.max(int(share * float(frames)), 1))


@wp.kernel
def look_up_samples(
    start: int, grid: CacheGrid, samples: CacheSamples, tiles: CacheTiles, radiance_out: wp.array[wp.vec3]
):
    """Radiance of each sample's surface, linear; 0 where there is none."""
    i = start + wp.tid()
    radiance_out[i] = wp.vec3()
    if samples.is_active[i]:
        radiance_out[i] = cached_radiance(tiles, grid, samples, i)


@wp.kernel
def look_up_indirect(
    start: int,
    grid: CacheGrid,
    samples: CacheSamples,
    points: wp.array[wp.vec3],
    tiles: CacheTiles,
    radiance_out: wp.array[wp.vec3],
):
    """Radiance that each sample's surface reflects of light from other surfaces, linear; 0 where there is none.

    It is looked up at its point, if something is known there; else, and without points, at its position.
    """
    i = start + wp.tid()
    radiance_out[i] = wp.vec3()
    if samples.is_active[i]:
        level = level_of(grid, samples.position[i], samples.from_eye[i])
        light = CellLight()
        if points:
            light = far_radiance(tiles, grid, samples, i, points[i], level)
        if not light.is_known:
            light = far_radiance(tiles, grid, samples, i, samples.position[i], level)
        radiance_out[i] = light.indirect


@wp.kernel
def number_cells(start: int, grid: CacheGrid, samples: CacheSamples, tiles: CacheTiles, numbers_out: wp.array[int]):
    """Item = sample: a hash of its cell, of 24 bits; -1: it is in none."""
    i = start + wp.tid()
    numbers_out[i] = -1
    if samples.is_active[i]:
        address = cell_of_sample(grid, samples, i)
        if slot_of(tiles, address.key) >= 0:
            numbers_out[i] = int(cell_key(address.key, address.cell, 0) & wp.uint32(0xFFFFFF))


@wp.kernel
def key_tiles_by_bounce(start: int, tiles: CacheTiles, ages_out: wp.array[int], ranks_out: wp.array[int]):
    """When rays last left from each tile; sorted by it, those come first that wait longest."""
    rank = start + wp.tid()
    ranks_out[rank] = rank
    ages_out[rank] = AGE_LAST
    if rank < tiles.counts[COUNT_LIVE]:
        ages_out[rank] = tiles.bounced[tiles.slots[rank]]


@wp.kernel
def count_cells(start: int, tiles: CacheTiles, ranks: wp.array[int], near_out: wp.array[int], far_out: wp.array[int]):
    """Cells with samples of each tile, in an order: of short rays, or of long ones."""
    i = start + wp.tid()
    near_out[i] = 0
    far_out[i] = 0
    if ranks[i] < tiles.counts[COUNT_LIVE]:
        cells = tiles.filled[tiles.slots[ranks[i]]]
        if is_of_short_rays(tiles.keys[ranks[i]]):
            near_out[i] = cells
        else:
            far_out[i] = cells


@wp.func
def near_rays(budget: int, near: int, far: int) -> int:
    """Rays for cells of short rays: one each, but no more than half of all if cells of long rays can use the others."""
    return wp.min(near, wp.max(budget - RAYS_MAX * far, budget // 2))


@wp.func
def tile_of_ray(ends: wp.array[int], ray: int, budget: int, rays: int) -> int:
    """The tile in an order whose cells, with so many rays each, send a ray; -1: none that fits whole."""
    tile = first_not_below(ends, ends.shape[0], ray // rays + 1)
    if tile < ends.shape[0]:
        if ends[tile] * rays <= budget:
            return tile
    return -1


@wp.func
def filled_cell(tiles: CacheTiles, slot: int, number: int) -> int:
    """The cell with this number among those of a tile that have samples."""
    cell = int(-1)
    while number >= 0:
        cell += 1
        if tiles.frames[slot * TILE_CELLS + cell] > 0:
            number -= 1
    return cell


@wp.kernel
def list_points(
    start: int,
    frame: int,
    tiles: CacheTiles,
    ranks: wp.array[int],
    near_ends: wp.array[int],
    far_ends: wp.array[int],
    points: CachePoints,
):
    """Item = ray: the point of its cell, of the tiles that wait longest; as many whole tiles as fit.

    Args:
        start: First item.
        frame: Number of the frame.
        tiles: Tiles of the cache.
        ranks: Ranks of the tiles, those that wait longest first.
        near_ends: Cells of short rays in the tiles up to each rank.
        far_ends: Cells of long rays, likewise.
        points: Points of the rays, first those of cells of short rays.
    """
    i = start + wp.tid()
    points.is_active[i] = False
    points.slot[i] = -1
    last = near_ends.shape[0] - 1
    near = near_rays(points.slot.shape[0], near_ends[last], far_ends[last])
    is_near = i < near
    ray = i
    rays = int(1)
    tile = int(-1)
    if is_near:
        tile = tile_of_ray(near_ends, ray, near, 1)
    else:
        ray -= near
        rest = points.slot.shape[0] - near
        rays = wp.clamp(rest // wp.max(far_ends[last], 1), 1, RAYS_MAX)
        tile = tile_of_ray(far_ends, ray, rest, rays)
    if tile < 0:
        return
    rank = ranks[tile]
    slot = tiles.slots[rank]
    end = wp.where(is_near, near_ends[tile], far_ends[tile])
    number = ray - rays * (end - tiles.filled[slot])
    cell = filled_cell(tiles, slot, number // rays)
    if number == 0:
        tiles.bounced[slot] = frame + 1
    at = slot * TILE_CELLS + cell
    points.is_active[i] = True
    points.position[i] = tiles.position[at]
    points.normal[i] = tiles.normal[at]
    points.extent[i] = tiles.extent[at]
    points.key[i] = cell_key(tiles.keys[rank], cell, frame)
    points.ray[i] = number % rays
    points.rays[i] = rays
    points.slot[i] = slot
    points.cell[i] = cell


@wp.kernel
def copy_means(start: int, points: CachePoints, tiles: CacheTiles, means_out: wp.array[wp.vec4]):
    """Item = ray: the mean of its cell before the bounces of the frame."""
    i = start + wp.tid()
    if points.is_active[i]:
        means_out[i] = tiles.indirect[points.slot[i] * TILE_MEANS + points.cell[i]]


@wp.kernel
def add_bounces(
    start: int,
    grid: CacheGrid,
    points: CachePoints,
    means: wp.array[wp.vec4],
    radiance: wp.array[wp.vec3],
    tiles: CacheTiles,
):
    """Adds the radiance of the rays of a cell to its mean of before; the first ray does it for all.

    The mean over rays that follow the cosine of the normal is the irradiance over pi. A slot that has gone to another
    tile since is skipped: it has not bounced.
    """
    i = start + wp.tid()
    if points.is_active[i] and points.ray[i] == 0 and tiles.bounced[points.slot[i]] > 0:
        total = wp.vec3d()
        count = int(0)
        for ray in range(i, i + points.rays[i]):
            if wp.isfinite(radiance[ray]):
                total += wp.vec3d(radiance[ray])
                count += 1
        if count > 0:
            before = means[i][3]
            mean = mean_with(means[i], mean_weight(before, grid.bounce_history), total, count)
            mean[3] = wp.min(before + float(count), wp.max(grid.bounce_history, grid.samples_min))
            tiles.indirect[points.slot[i] * TILE_MEANS + points.cell[i]] = mean


@wp.kernel
def update_bounced_tiles(start: int, points: CachePoints, tiles: CacheTiles):
    """Means over squares of the tiles that rays have left from; the first point of each does it."""
    i = start + wp.tid()
    if points.is_active[i]:
        if i == 0 or points.slot[wp.max(i - 1, 0)] != points.slot[i]:
            average_mips(tiles.indirect, points.slot[i])


@wp.kernel
def clear_tiles(start: int, tiles: CacheTiles):
    """Item = tile: its slot is free."""
    rank = start + wp.tid()
    tiles.keys[rank] = NO_TILE
    tiles.slots[rank] = rank
    if rank < COUNTS:
        tiles.counts[rank] = 0


@wp.kernel
def find_new_tiles(start: int, frame: int, samples: SortedSamples, tiles: CacheTiles, is_new_out: wp.array[int]):
    """Marks the first sample of each tile that there is not yet; the others' tiles are used in this frame."""
    i = start + wp.tid()
    is_new_out[i] = 0
    if is_first_of_tile(samples, i):
        slot = slot_of(tiles, samples.keys[i])
        if slot >= 0:
            tiles.used[slot] = frame
        else:
            is_new_out[i] = 1


@wp.kernel
def list_new_tiles(
    start: int, samples: SortedSamples, is_new: wp.array[int], ends: wp.array[int], keys_out: wp.array[wp.int64]
):
    """Keys of the new tiles, ascending."""
    i = start + wp.tid()
    if is_new[i] == 1:
        keys_out[ends[i] - 1] = samples.keys[i]


@wp.kernel
def count_new_tiles(count: int, grid: CacheGrid, ends: wp.array[int], tiles: CacheTiles):
    """How many tiles are new, and how many of them are too many. One item."""
    tiles.counts[COUNT_NEW] = ends[count - 1]
    tiles.counts[COUNT_EXCESS] = wp.max(tiles.counts[COUNT_LIVE] + ends[count - 1] - grid.tiles, 0)


@wp.kernel
def key_tiles_by_use(start: int, tiles: CacheTiles, ages_out: wp.array[int], ranks_out: wp.array[int]):
    """The last frame that used each tile; sorted by it, those come first that were unused longest."""
    rank = start + wp.tid()
    ranks_out[rank] = rank
    ages_out[rank] = AGE_LAST
    if rank < tiles.counts[COUNT_LIVE]:
        ages_out[rank] = tiles.used[tiles.slots[rank]]


@wp.kernel
def mark_all_but_excess(start: int, frame: int, tiles: CacheTiles, ranks: wp.array[int], stays_out: wp.array[int]):
    """Marks the tiles that stay when new ones need room; tiles of this frame always do."""
    i = start + wp.tid()
    rank = ranks[i]
    stays = int(rank < tiles.counts[COUNT_LIVE])
    if stays == 1 and i < tiles.counts[COUNT_EXCESS]:
        stays = int(tiles.used[tiles.slots[rank]] == frame)
    stays_out[rank] = stays


@wp.kernel
def mark_used(start: int, oldest: int, tiles: CacheTiles, stays_out: wp.array[int]):
    """Marks the tiles that a ray has hit in frame ``oldest`` or later."""
    rank = start + wp.tid()
    stays_out[rank] = 0
    if rank < tiles.counts[COUNT_LIVE]:
        stays_out[rank] = int(tiles.used[tiles.slots[rank]] >= oldest)


@wp.kernel
def compact_tiles(
    start: int,
    tiles: CacheTiles,
    stays: wp.array[int],
    ends: wp.array[int],
    keys_out: wp.array[wp.int64],
    slots_out: wp.array[int],
):
    """Moves the tiles that stay to the front, in order; the slots of the others are free."""
    rank = start + wp.tid()
    target = ends[ends.shape[0] - 1] + rank - ends[rank]
    key = NO_TILE
    if stays[rank] == 1:
        target = ends[rank] - 1
        key = tiles.keys[rank]
    keys_out[target] = key
    slots_out[target] = tiles.slots[rank]


@wp.kernel
def count_remaining_tiles(is_early: bool, grid: CacheGrid, ends: wp.array[int], tiles: CacheTiles):
    """How many tiles have stayed, and how many new ones find room then. One item."""
    remaining = ends[ends.shape[0] - 1]
    if is_early:
        room = wp.min(tiles.counts[COUNT_NEW], grid.tiles - remaining)
        tiles.counts[COUNT_EVICTED] += tiles.counts[COUNT_LIVE] - remaining
        tiles.counts[COUNT_DROPPED] += tiles.counts[COUNT_NEW] - room
        tiles.counts[COUNT_NEW] = room
    tiles.counts[COUNT_LIVE] = remaining


@wp.func
def clear_slot(tiles: CacheTiles, slot: int):
    """Makes a slot that of a tile without samples."""
    tiles.bounced[slot] = 0
    tiles.filled[slot] = 0
    for i in range(slot * TILE_MEANS, (slot + 1) * TILE_MEANS):
        tiles.direct[i] = wp.vec4()
        tiles.indirect[i] = wp.vec4()
    for i in range(slot * TILE_CELLS, (slot + 1) * TILE_CELLS):
        tiles.frames[i] = 0


@wp.kernel
def merge_tiles(
    start: int,
    frame: int,
    tiles: CacheTiles,
    new_keys: wp.array[wp.int64],
    keys_out: wp.array[wp.int64],
    slots_out: wp.array[int],
):
    """Merges the new keys into the sorted ones: each moves by the keys of the other list that are below it."""
    rank = start + wp.tid()
    live = tiles.counts[COUNT_LIVE]
    new = tiles.counts[COUNT_NEW]
    slot = tiles.slots[rank]
    target = rank
    key = NO_TILE
    if rank < live:
        key = tiles.keys[rank]
        target += first_not_below(new_keys, new, key)
    elif rank < live + new:
        key = new_keys[rank - live]
        target += first_not_below(tiles.keys, live, key) - live
        clear_slot(tiles, slot)
        tiles.used[slot] = frame
    keys_out[target] = key
    slots_out[target] = slot


@wp.kernel
def count_merged_tiles(tiles: CacheTiles):
    """How many tiles there are now. One item."""
    tiles.counts[COUNT_LIVE] += tiles.counts[COUNT_NEW]
    tiles.counts[COUNT_NEW] = 0
