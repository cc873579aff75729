"""Kernels of the radiance cache: they sort samples into cells, pass light between cells, and insert and evict tiles.

A ray that is shorter than the width of a coarse cell uses fine cells, every other ray coarse cells. Each array element
has one writer: the first of a cell's or tile's sorted samples does the work of all. Tiles are stored as a sorted list
of keys, into which new keys are merged (docs/method/realtime.md#radiance-cache).
"""

import warp as wp

from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.light_visibility import LightValues
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
    is_first_of_cell,
    is_first_of_tile,
    is_of_short_rays,
    level_of,
    long_ray_radiance,
    mean_index,
    slot_of,
)
from lumisplat.device.gi.surfaces import SequenceData, mean_weight
from lumisplat.device.math.random import mix
from lumisplat.device.math.sorting import first_not_below

wp.set_module_options({"enable_backward": False})

CELL_RAYS_MAX = 16
"""Largest number of rays per frame from a coarse cell, if few cells share the rays of a frame."""

ARRIVED_BEFORE = wp.constant(wp.float32(3.0))
"""Number of samples for which the fraction of a light that arrived in a cell before counts against new samples."""

LIGHTS = wp.constant(GRID_LIGHTS)

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
    """Per sample: writes the key of its tile (8 x 8 cells) and its cell; "no tile" if the sample is not finite."""
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
    """Per sample, in sorted order: writes the key of its tile."""
    i = start + wp.tid()
    keys_out[i] = keys[order[i]]


@wp.func
def mean_with(mean: wp.vec4, weight: float, total: wp.vec3d, count: int) -> wp.vec4:
    """Adds ``count`` samples with sum ``total`` to a mean that counts for ``weight`` samples; returns the new mean."""
    before = wp.float64(weight)
    all = before + wp.float64(count)
    color = (wp.vec3d(color_of(mean)) * before + total) / all
    return wp.vec4(float(color[0]), float(color[1]), float(color[2]), float(all))


@wp.kernel
def add_samples(
    start: int,
    sequence: wp.array[SequenceData],
    grid: CacheGrid,
    samples: CacheSamples,
    sorted_samples: SortedSamples,
    tiles: CacheTiles,
):
    """Per cell: adds its samples to the cell's mean and to the fractions of lights that arrive.

    A random sample is stored as the origin of the cell's bounce ray.
    """
    i = start + wp.tid()
    if not is_first_of_cell(sorted_samples, i):
        return
    key = sorted_samples.keys[i]
    slot = slot_of(tiles, key)
    if slot < 0:
        return
    cell = sorted_samples.cells[sorted_samples.order[i]]
    at = slot * TILE_CELLS + cell
    total = wp.vec3d()
    arrived = LightValues()
    sampled = LightValues()
    end = int(i)
    while end < samples.is_active.shape[0] and (end == i or not is_first_of_cell(sorted_samples, end)):
        if sorted_samples.keys[end] == NO_TILE:
            break
        sample = sorted_samples.order[end]
        total += wp.vec3d(samples.radiance[sample])
        light = samples.light[sample]
        if light >= 0:
            arrived[light] = arrived[light] + wp.clamp(samples.arrived[sample], 0.0, 1.0)
            sampled[light] = sampled[light] + 1.0
        end += 1
    for light in range(LIGHTS):
        if sampled[light] > 0.0:
            before = ARRIVED_BEFORE * float(tiles.arrived[at * LIGHTS + light])
            now = (before + 255.0 * arrived[light]) / (ARRIVED_BEFORE + sampled[light])
            tiles.arrived[at * LIGHTS + light] = wp.uint8(now + 0.5)
    frame = sequence[0].frame
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
    """Writes the mip levels of a tile's mean radiance: each element is the weighted mean of 2 x 2 finer elements.

    Elements are weighted by their numbers of samples.
    """
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
    """Updates the mip levels and the number of filled cells of tiles that received samples."""
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
def outdate_means(start: int, sequence: wp.array[SequenceData], tiles: CacheTiles):
    """Per mean of a tile: multiplies its weight by that of cached lighting, both in samples and in frames."""
    i = start + wp.tid()
    share = sequence[0].history_weight
    tile = i // TILE_MEANS
    if share >= 1.0 or tile >= tiles.counts[COUNT_LIVE]:
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
    """Writes the linear radiance that each sample's surface reflects; 0 for inactive samples."""
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
    """Writes the linear radiance that each sample's surface reflects, of light from other surfaces; 0 if not stored.

    The cell is looked up at ``points`` if that cell has data; otherwise, or if ``points`` is empty, at the sample's
    position.
    """
    i = start + wp.tid()
    radiance_out[i] = wp.vec3()
    if samples.is_active[i]:
        level = level_of(grid, samples.position[i], samples.from_eye[i])
        light = CellLight()
        if points:
            light = long_ray_radiance(tiles, grid, samples, i, points[i], level)
        if not light.is_valid:
            light = long_ray_radiance(tiles, grid, samples, i, samples.position[i], level)
        radiance_out[i] = light.indirect


@wp.kernel
def number_cells(start: int, grid: CacheGrid, samples: CacheSamples, tiles: CacheTiles, numbers_out: wp.array[int]):
    """Per sample: writes a 24-bit hash of the sample's cell; -1 if the sample has no cell."""
    i = start + wp.tid()
    numbers_out[i] = -1
    if samples.is_active[i]:
        address = cell_of_sample(grid, samples, i)
        if slot_of(tiles, address.key) >= 0:
            numbers_out[i] = int(cell_key(address.key, address.cell, 0) & wp.uint32(0xFFFFFF))


@wp.kernel
def key_tiles_by_bounce(start: int, tiles: CacheTiles, ages_out: wp.array[int], ranks_out: wp.array[int]):
    """Per tile: writes the frame in which its cells last sent rays, a sort key that puts the longest wait first."""
    rank = start + wp.tid()
    ranks_out[rank] = rank
    ages_out[rank] = AGE_LAST
    if rank < tiles.counts[COUNT_LIVE]:
        ages_out[rank] = tiles.bounced[tiles.slots[rank]]


@wp.kernel
def count_cells(start: int, tiles: CacheTiles, ranks: wp.array[int], near_out: wp.array[int], far_out: wp.array[int]):
    """Writes each tile's number of filled cells in the order of ``ranks``: fine cells and coarse cells separately."""
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
    """Returns how many of ``budget`` rays go to fine cells: at most one per cell.

    Coarse cells get the rays that they can use, up to half of the budget. If fine cells cannot use the other half,
    coarse cells may get rays from it, too.
    """
    return wp.min(near, wp.max(budget - RAYS_MAX * far, budget // 2))


@wp.func
def tile_of_ray(ends: wp.array[int], ray: int, budget: int, rays: int) -> int:
    """Returns the rank (index in sort order) of the tile where ``ray`` starts; each filled cell sends ``rays`` rays.

    A tile sends rays only if all of them fit into ``budget``; for further rays, the result is -1. ``ends`` is the
    running sum, over the ranks, of the number of filled cells.
    """
    tile = first_not_below(ends, ends.shape[0], ray // rays + 1)
    if tile < ends.shape[0]:
        if ends[tile] * rays <= budget:
            return tile
    return -1


@wp.func
def filled_cell(tiles: CacheTiles, slot: int, number: int) -> int:
    """Returns a filled cell's index in its tile. ``number`` is the cell's index among the filled cells of the tile."""
    cell = int(-1)
    while number >= 0:
        cell += 1
        if tiles.frames[slot * TILE_CELLS + cell] > 0:
            number -= 1
    return cell


@wp.kernel
def list_points(
    start: int,
    sequence: wp.array[SequenceData],
    tiles: CacheTiles,
    ranks: wp.array[int],
    near_ends: wp.array[int],
    far_ends: wp.array[int],
    points: CachePoints,
):
    """Per ray: writes the ray's origin in a cell. Tiles that waited longest come first; only whole tiles are listed.

    Args:
        start: Offset added to the thread index.
        sequence: The frame in its sequence; its number is read.
        tiles: Tiles of the cache.
        ranks: Ranks of the tiles, longest wait first.
        near_ends: Running sum over the ranks of the number of fine cells.
        far_ends: Running sum over the ranks of the number of coarse cells.
        points: Origins of the rays; those in fine cells come first.
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
    frame = sequence[0].frame
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
    """Per ray: copies the mean indirect radiance of the cell where the ray starts, from before this frame's bounces."""
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
    """Per cell: adds the radiance of its rays to its previous mean; the thread of the cell's first ray does it.

    The mean over cosine-weighted rays is the irradiance divided by pi. Rays of evicted tiles, whose slot another tile
    has taken since, are skipped.
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
    """Updates the mip levels of tiles whose cells sent rays; the first point of each tile does the work."""
    i = start + wp.tid()
    if points.is_active[i]:
        if i == 0 or points.slot[wp.max(i - 1, 0)] != points.slot[i]:
            average_mips(tiles.indirect, points.slot[i])


@wp.kernel
def clear_tiles(start: int, tiles: CacheTiles):
    """Per tile: frees the tile's storage slot."""
    rank = start + wp.tid()
    tiles.keys[rank] = NO_TILE
    tiles.slots[rank] = rank
    if rank < COUNTS:
        tiles.counts[rank] = 0


@wp.kernel
def find_new_tiles(
    start: int,
    sequence: wp.array[SequenceData],
    samples: SortedSamples,
    tiles: CacheTiles,
    is_new_out: wp.array[int],
):
    """Marks the first sample of each tile that does not exist yet; marks existing tiles as used in this frame."""
    i = start + wp.tid()
    is_new_out[i] = 0
    if is_first_of_tile(samples, i):
        slot = slot_of(tiles, samples.keys[i])
        if slot >= 0:
            tiles.used[slot] = sequence[0].frame
        else:
            is_new_out[i] = 1


@wp.kernel
def list_new_tiles(
    start: int, samples: SortedSamples, is_new: wp.array[int], ends: wp.array[int], keys_out: wp.array[wp.int64]
):
    """Writes the keys of the tiles that samples need but that do not exist yet, ascending."""
    i = start + wp.tid()
    if is_new[i] == 1:
        keys_out[ends[i] - 1] = samples.keys[i]


@wp.kernel
def count_new_tiles(count: int, grid: CacheGrid, ends: wp.array[int], tiles: CacheTiles):
    """Counts the new tiles, and how many of them exceed the capacity. Runs as one thread."""
    tiles.counts[COUNT_NEW] = ends[count - 1]
    tiles.counts[COUNT_EXCESS] = wp.max(tiles.counts[COUNT_LIVE] + ends[count - 1] - grid.tiles, 0)


@wp.kernel
def key_tiles_by_use(start: int, tiles: CacheTiles, ages_out: wp.array[int], ranks_out: wp.array[int]):
    """Writes the last frame that used each tile, the sort key that puts the tiles unused for longest first."""
    rank = start + wp.tid()
    ranks_out[rank] = rank
    ages_out[rank] = AGE_LAST
    if rank < tiles.counts[COUNT_LIVE]:
        ages_out[rank] = tiles.used[tiles.slots[rank]]


@wp.kernel
def mark_all_but_excess(
    start: int,
    sequence: wp.array[SequenceData],
    tiles: CacheTiles,
    ranks: wp.array[int],
    stays_out: wp.array[int],
):
    """Marks the tiles that remain when new tiles need space: all except those unused for longest.

    Tiles used in this frame always remain.
    """
    i = start + wp.tid()
    rank = ranks[i]
    stays = int(rank < tiles.counts[COUNT_LIVE])
    if stays == 1 and i < tiles.counts[COUNT_EXCESS]:
        stays = int(tiles.used[tiles.slots[rank]] == sequence[0].frame)
    stays_out[rank] = stays


@wp.kernel
def mark_used(start: int, sequence: wp.array[SequenceData], frames: int, tiles: CacheTiles, stays_out: wp.array[int]):
    """Marks the tiles that a ray has hit in the last ``frames`` frames."""
    rank = start + wp.tid()
    stays_out[rank] = 0
    if rank < tiles.counts[COUNT_LIVE]:
        stays_out[rank] = int(tiles.used[tiles.slots[rank]] > sequence[0].frame - frames)


@wp.kernel
def compact_tiles(
    start: int,
    tiles: CacheTiles,
    stays: wp.array[int],
    ends: wp.array[int],
    keys_out: wp.array[wp.int64],
    slots_out: wp.array[int],
):
    """Moves the tiles marked in ``stays`` to the front, in order, and frees the storage slots of all other tiles."""
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
    """Counts the tiles that remain after others were evicted, and the new tiles that fit. Runs as one thread.

    ``is_early``: tiles were evicted because the cache was full.
    """
    remaining = ends[ends.shape[0] - 1]
    if is_early:
        added = wp.min(tiles.counts[COUNT_NEW], grid.tiles - remaining)
        tiles.counts[COUNT_EVICTED] += tiles.counts[COUNT_LIVE] - remaining
        tiles.counts[COUNT_DROPPED] += tiles.counts[COUNT_NEW] - added
        tiles.counts[COUNT_NEW] = added
    tiles.counts[COUNT_LIVE] = remaining


@wp.func
def clear_slot(tiles: CacheTiles, slot: int):
    """Resets the storage slot of a tile, so that it holds a tile without samples."""
    tiles.bounced[slot] = 0
    tiles.filled[slot] = 0
    for i in range(slot * TILE_MEANS, (slot + 1) * TILE_MEANS):
        tiles.direct[i] = wp.vec4()
        tiles.indirect[i] = wp.vec4()
    for i in range(slot * TILE_CELLS, (slot + 1) * TILE_CELLS):
        tiles.frames[i] = 0
    for i in range(slot * TILE_CELLS * LIGHTS, (slot + 1) * TILE_CELLS * LIGHTS):
        tiles.arrived[i] = wp.uint8(255)


@wp.kernel
def merge_tiles(
    start: int,
    sequence: wp.array[SequenceData],
    tiles: CacheTiles,
    new_keys: wp.array[wp.int64],
    keys_out: wp.array[wp.int64],
    slots_out: wp.array[int],
):
    """Merges new tiles' keys into the sorted keys: each key moves by the number of smaller keys in the other list."""
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
        tiles.used[slot] = sequence[0].frame
    keys_out[target] = key
    slots_out[target] = slot


@wp.kernel
def count_merged_tiles(tiles: CacheTiles):
    """Updates the number of tiles in use after a merge. Runs as one thread."""
    tiles.counts[COUNT_LIVE] += tiles.counts[COUNT_NEW]
    tiles.counts[COUNT_NEW] = 0
