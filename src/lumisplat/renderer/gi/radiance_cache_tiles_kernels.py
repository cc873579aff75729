"""Kernels of the radiance cache's tiles: sorted keys into which new ones are merged, and out of which old ones go.

docs/method/realtime.md#radiance-cache
"""

import warp as wp

from lumisplat.device.gi.radiance_cache import is_first_of_tile, slot_of
from lumisplat.device.math.search import first_not_below
from lumisplat.device.structs.radiance_cache import (
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
    CacheGrid,
    CacheTiles,
    SortedSamples,
)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def clear_tiles(start: int, tiles: CacheTiles):
    """No tiles: all slots are free."""
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
def keep_all_but_excess(start: int, frame: int, tiles: CacheTiles, ranks: wp.array[int], kept_out: wp.array[int]):
    """Marks the tiles that stay when new ones need room; tiles of this frame always do."""
    i = start + wp.tid()
    rank = ranks[i]
    kept = int(rank < tiles.counts[COUNT_LIVE])
    if kept == 1 and i < tiles.counts[COUNT_EXCESS]:
        kept = int(tiles.used[tiles.slots[rank]] == frame)
    kept_out[rank] = kept


@wp.kernel
def keep_used(start: int, oldest: int, tiles: CacheTiles, kept_out: wp.array[int]):
    """Marks the tiles that a ray has hit in frame ``oldest`` or later."""
    rank = start + wp.tid()
    kept_out[rank] = 0
    if rank < tiles.counts[COUNT_LIVE]:
        kept_out[rank] = int(tiles.used[tiles.slots[rank]] >= oldest)


@wp.kernel
def compact_tiles(
    start: int,
    tiles: CacheTiles,
    kept: wp.array[int],
    ends: wp.array[int],
    keys_out: wp.array[wp.int64],
    slots_out: wp.array[int],
):
    """Moves the tiles that stay to the front, in order; the slots of the others are free."""
    rank = start + wp.tid()
    target = ends[ends.shape[0] - 1] + rank - ends[rank]
    key = NO_TILE
    if kept[rank] == 1:
        target = ends[rank] - 1
        key = tiles.keys[rank]
    keys_out[target] = key
    slots_out[target] = tiles.slots[rank]


@wp.kernel
def count_kept_tiles(is_early: bool, grid: CacheGrid, ends: wp.array[int], tiles: CacheTiles):
    """How many tiles have stayed, and how many new ones find room then. One item."""
    kept = ends[ends.shape[0] - 1]
    if is_early:
        room = wp.min(tiles.counts[COUNT_NEW], grid.tiles - kept)
        tiles.counts[COUNT_EVICTED] += tiles.counts[COUNT_LIVE] - kept
        tiles.counts[COUNT_DROPPED] += tiles.counts[COUNT_NEW] - room
        tiles.counts[COUNT_NEW] = room
    tiles.counts[COUNT_LIVE] = kept


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
