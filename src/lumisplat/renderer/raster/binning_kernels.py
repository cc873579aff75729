"""Kernels that sort splats or triangles (items) by depth and list them per tile, in two schedules.

Chunked (CPU): one thread per contiguous chunk of the items. A counting sort counts digits (or tiles) per chunk, a
single scan turns counts into write positions, and each chunk scatters to its positions. The sort is stable, writes each
position once, and needs no atomics.

Parallel (CUDA): one thread per Gaussian or per (tile, splat) pair. Radix sort and scan are Warp's. They cover the
capacities of lists instead of their lengths, so that no length is read back.
"""

import warp as wp

from lumisplat.constants import COUNT_SUM_THREADS, DEPTH_KEY_CULLED, DEPTH_KEY_NONFINITE, FUSED_FLAGS
from lumisplat.device.camera.pixels import rect_area
from lumisplat.device.math.sorting import first_not_below
from lumisplat.device.structs.raster import ChunkData, TileRect

# The splat kernels' flags, so that an unlit raster frame needs only one precompiled header.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

KEY_NONFINITE = wp.constant(wp.uint32(DEPTH_KEY_NONFINITE))
KEY_CULLED = wp.constant(wp.uint32(DEPTH_KEY_CULLED))
SUM_THREADS = wp.constant(COUNT_SUM_THREADS)


@wp.func
def chunk_edge(chunk: int, chunks: int, count: int) -> int:
    """Returns where chunk ``chunk`` begins if ``count`` splats or triangles are divided into ``chunks`` chunks."""
    return int(wp.int64(count) * wp.int64(chunk) / wp.int64(chunks))


@wp.kernel
def measure_keys(start: int, chunks: int, keys: wp.array[wp.uint32], chunk_out: wp.array[ChunkData]):
    """Per chunk: writes how many of its depth keys are visible, and the lowest and the highest visible key."""
    chunk = start + wp.tid()
    data = ChunkData()
    data.key_min = KEY_CULLED
    for i in range(chunk_edge(chunk, chunks, keys.shape[0]), chunk_edge(chunk + 1, chunks, keys.shape[0])):
        key = keys[i]
        if key < KEY_NONFINITE:
            data.key_min = wp.min(data.key_min, key)
            data.key_max = wp.max(data.key_max, key)
            data.visible += 1
        elif key == KEY_NONFINITE:
            data.nonfinite += 1
    chunk_out[chunk] = data


@wp.kernel
def count_digits(
    start: int,
    chunks: int,
    count: int,
    key_min: wp.uint32,
    shift: wp.uint32,
    mask: wp.uint32,
    keys: wp.array[wp.uint32],
    counts_out: wp.array2d[int],
):
    """Per chunk: writes how often each value of a radix digit occurs among the depth keys that are not culled."""
    chunk = start + wp.tid()
    for digit in range(counts_out.shape[1]):
        counts_out[chunk, digit] = 0
    for i in range(chunk_edge(chunk, chunks, count), chunk_edge(chunk + 1, chunks, count)):
        key = keys[i]
        if key < KEY_NONFINITE:
            digit = int(((key - key_min) >> shift) & mask)
            counts_out[chunk, digit] = counts_out[chunk, digit] + 1


@wp.kernel
def scatter_digits(
    start: int,
    chunks: int,
    count: int,
    key_min: wp.uint32,
    shift: wp.uint32,
    mask: wp.uint32,
    first_pass: bool,
    keys: wp.array[wp.uint32],
    indices: wp.array[int],
    positions: wp.array2d[int],
    keys_out: wp.array[wp.uint32],
    indices_out: wp.array[int],
):
    """Per chunk: moves its depth keys to the positions of their radix digit; the first pass drops culled keys."""
    chunk = start + wp.tid()
    for i in range(chunk_edge(chunk, chunks, count), chunk_edge(chunk + 1, chunks, count)):
        key = keys[i]
        if key < KEY_NONFINITE:
            digit = int(((key - key_min) >> shift) & mask)
            position = positions[chunk, digit]
            positions[chunk, digit] = position + 1
            keys_out[position] = key
            if first_pass:
                indices_out[position] = i
            else:
                indices_out[position] = indices[i]


@wp.kernel
def scan_counts(chunks: int, counts: wp.array2d[int], starts_out: wp.array[int]):
    """Turns the counts of each chunk (row) and each digit or tile (column) into write positions, in place.

    Positions run chunk by chunk within a column, and column by column. ``starts_out`` receives the start of each
    column, and at the end the total.
    """
    total = int(0)
    for column in range(counts.shape[1]):
        starts_out[column] = total
        for chunk in range(chunks):
            count = counts[chunk, column]
            counts[chunk, column] = total
            total += count
    starts_out[counts.shape[1]] = total


@wp.kernel
def count_tiles(
    start: int,
    chunks: int,
    count: int,
    tiles_x: int,
    order: wp.array[int],
    rects: wp.array[TileRect],
    counts_out: wp.array2d[int],
    ordered_rects_out: wp.array[TileRect],
    pairs_out: wp.array[wp.int64],
):
    """Per chunk of splats or triangles: counts how many touch each tile, and the sum over tiles in 64 bits.

    Also writes their rectangles in depth order, for ``scatter_tiles``.
    """
    chunk = start + wp.tid()
    pairs = wp.int64(0)
    for tile in range(counts_out.shape[1]):
        counts_out[chunk, tile] = 0
    for i in range(chunk_edge(chunk, chunks, count), chunk_edge(chunk + 1, chunks, count)):
        rect = rects[order[i]]
        ordered_rects_out[i] = rect
        pairs += wp.int64(rect_area(rect))
        for y in range(int(rect.y0), int(rect.y1)):
            for x in range(int(rect.x0), int(rect.x1)):
                tile = y * tiles_x + x
                counts_out[chunk, tile] = counts_out[chunk, tile] + 1
    pairs_out[chunk] = pairs


@wp.kernel
def scatter_tiles(
    start: int,
    chunks: int,
    count: int,
    tiles_x: int,
    order: wp.array[int],
    ordered_rects: wp.array[TileRect],
    positions: wp.array2d[int],
    items_out: wp.array[int],
):
    """Per chunk of splats or triangles: appends each to the lists of the tiles that it touches, in depth order."""
    chunk = start + wp.tid()
    for i in range(chunk_edge(chunk, chunks, count), chunk_edge(chunk + 1, chunks, count)):
        item = order[i]
        rect = ordered_rects[i]
        for y in range(int(rect.y0), int(rect.y1)):
            for x in range(int(rect.x0), int(rect.x1)):
                tile = y * tiles_x + x
                position = positions[chunk, tile]
                positions[chunk, tile] = position + 1
                items_out[position] = item


@wp.kernel
def fill_identity(start: int, order_out: wp.array[int]):
    """Writes 0, 1, 2, ... to ``order_out``: the items in their original order."""
    i = start + wp.tid()
    order_out[i] = i


@wp.kernel
def count_sorted_keys(count: int, sorted_keys: wp.array[wp.uint32], totals_out: wp.array[wp.int64]):
    """Writes the numbers of visible and of non-finite Gaussians among sorted depth keys to the totals."""
    visible = first_not_below(sorted_keys, count, KEY_NONFINITE)
    totals_out[0] = wp.int64(visible)
    totals_out[1] = wp.int64(first_not_below(sorted_keys, count, KEY_CULLED) - visible)


@wp.kernel
def sum_pairs(start: int, counts: wp.array[int], slot: int, totals_inout: wp.array[wp.int64]):
    """Adds up how many tiles all splats or triangles touch, in 64 bits; each thread sums every 4096th count.

    Not to be split over CPU threads, because the sum uses atomics.
    """
    total = wp.int64(0)
    i = start + wp.tid()
    while i < counts.shape[0]:
        total += wp.int64(counts[i])
        i += SUM_THREADS
    wp.atomic_add(totals_inout, slot, total)


@wp.kernel
def count_pairs(
    start: int,
    order: wp.array[int],
    rects: wp.array[TileRect],
    tile_starts: wp.array[int],
    counts_out: wp.array[int],
):
    """Per splat or triangle: counts the tiles that list it.

    The counts are in the order of ``order``; if that is empty, in the original order. There is one count more, so that
    an exclusive scan of the counts ends with the total. If ``tile_starts`` is given and its lists are empty, all counts
    are 0; otherwise, every tile that an item touches lists it.
    """
    i = start + wp.tid()
    counts_out[i] = 0
    is_listed = bool(True)
    if tile_starts:
        is_listed = tile_starts[tile_starts.shape[0] - 1] > 0
    if is_listed and i < counts_out.shape[0] - 1:
        item = i
        if order:
            item = order[i]
        counts_out[i] = rect_area(rects[item])


@wp.kernel
def clear_pairs(start: int, tile_count: int, tiles_out: wp.array[int]):
    """Per (tile, splat) pair: marks it as unused, so that it sorts behind all tiles."""
    tiles_out[start + wp.tid()] = tile_count


@wp.kernel
def emit_pairs(
    start: int,
    tiles_x: int,
    capacity: int,
    order: wp.array[int],
    rects: wp.array[TileRect],
    offsets: wp.array[int],
    tiles_out: wp.array[int],
    items_out: wp.array[int],
):
    """Per splat or triangle: writes its (tile, item) pairs; those beyond ``capacity`` are dropped.

    The total number of pairs tells how many were dropped. If the offsets overflow, positions may be negative.
    """
    i = start + wp.tid()
    item = order[i]
    rect = rects[item]
    position = offsets[i]
    for y in range(int(rect.y0), int(rect.y1)):
        for x in range(int(rect.x0), int(rect.x1)):
            if position >= 0 and position < capacity:
                tiles_out[position] = y * tiles_x + x
                items_out[position] = item
            position += 1


@wp.kernel
def find_tile_starts(
    start: int,
    capacity: int,
    slot: int,
    totals: wp.array[wp.int64],
    sorted_tiles: wp.array[int],
    starts_out: wp.array[int],
):
    """Per tile: finds its first pair in the sorted pairs by binary search; the last element is the number of pairs.

    All lists are empty if some pairs were dropped, because later passes count on complete lists.
    """
    tile = start + wp.tid()
    starts_out[tile] = 0
    if totals[slot] <= wp.int64(capacity):
        starts_out[tile] = first_not_below(sorted_tiles, capacity, tile)
