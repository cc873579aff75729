"""Host passes that order items by depth and list them per tile; two schedules with the same result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from lumisplat.buffers import Buffers
from lumisplat.constants import SORT_DIGIT_BITS_MAX
from lumisplat.device.structs import ChunkData, Rect
from lumisplat.launcher import Launcher
from lumisplat.render import order_kernels as kernels


@dataclass(frozen=True, slots=True)
class DepthOrder:
    """Items front to back; ties keep their order."""

    order: Any
    """Item indices; those after ``count`` are not visible."""
    count: int
    """Items to list; in the parallel schedule all of them, as the visible count stays on the device."""


@dataclass(frozen=True, slots=True)
class OrderCounts:
    """What the last frame's order held."""

    visible: int
    """Items that can touch the image."""
    nonfinite: int
    """Items dropped because a projected value was NaN or infinite."""
    pairs: int
    """(tile, splat) pairs."""


@dataclass(frozen=True, slots=True)
class TileLists:
    """Which items touch each tile, in depth order."""

    starts: Any
    """First entry of each tile, and last the total."""
    items: Any


class OrderChunked:
    """CPU schedule: counting sorts over one chunk a thread.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._visible, self._nonfinite, self._pairs = 0, 0, {}
        self.growth = 0
        """How often an overflow made lists larger; never, as counts are known in time."""

    def sort(self, keys: Any) -> DepthOrder:
        """Orders the visible items by key: a radix sort whose first pass also drops the culled ones."""
        run, buffers, chunks = self._launcher.run_banded, self._buffers, self._launcher.threads
        ranges = buffers.get("order.ranges", ChunkData, chunks)
        run(kernels.measure_keys, chunks, chunks, keys, ranges)
        measured = ranges.numpy()
        self._visible = visible = int(measured["visible"].sum())
        self._nonfinite = int(measured["nonfinite"].sum())
        capacity = keys.shape[0]
        spare = [buffers.get(f"order.keys{i}", wp.uint32, capacity) for i in (0, 1)]
        order = [buffers.get(f"order.indices{i}", wp.int32, capacity) for i in (0, 1)]
        if visible == 0:
            return DepthOrder(order[0], 0)
        key_min = int(measured["key_min"].min())
        bits = max(1, (int(measured["key_max"].max()) - key_min).bit_length())
        passes = -(-bits // SORT_DIGIT_BITS_MAX)
        digit_bits = -(-bits // passes)
        counts = buffers.get("order.digits", wp.int32, (chunks, 1 << digit_bits))
        starts = buffers.get("order.digit_starts", wp.int32, (1 << digit_bits) + 1)
        keys_in, order_in, count = keys, order[1], capacity
        for number in range(passes):
            digit = (wp.uint32(key_min), wp.uint32(number * digit_bits), wp.uint32((1 << digit_bits) - 1))
            keys_out, order_out = spare[number % 2], order[number % 2]
            run(kernels.count_digits, chunks, chunks, count, *digit, keys_in, counts)
            self._launcher.run(kernels.scan_counts, 1, chunks, counts, starts)
            run(
                kernels.scatter_digits,
                chunks,
                *(chunks, count, *digit, number == 0, keys_in, order_in, counts, keys_out, order_out),
            )
            keys_in, order_in, count = keys_out, order_out, visible
        return DepthOrder(order_in, visible)

    def unsorted(self, count: int) -> DepthOrder:
        """All items, in their own order."""
        order = self._buffers.get("order.identity", wp.int32, count)
        self._launcher.run_banded(kernels.fill_identity, count, order)
        return DepthOrder(order, count)

    def bin(self, name: str, depth_order: DepthOrder, rects: Any, tiles_x: int, tile_count: int) -> TileLists:
        """Lists the ordered items of each tile: a counting sort by tile."""
        run, buffers, chunks, count = (
            self._launcher.run_banded,
            self._buffers,
            self._launcher.threads,
            depth_order.count,
        )
        counts = buffers.get("order.tiles", wp.int32, (chunks, tile_count))
        starts = buffers.get(f"{name}.starts", wp.int32, tile_count + 1)
        ordered = buffers.get("order.rects", Rect, grown(count))
        run(kernels.count_tiles, chunks, chunks, count, tiles_x, depth_order.order, rects, counts, ordered)
        self._launcher.run(kernels.scan_counts, 1, chunks, counts, starts)
        self._pairs[name] = total = int(starts.numpy()[-1])
        items = buffers.get(f"{name}.items", wp.int32, grown(total))
        run(kernels.scatter_tiles, chunks, chunks, count, tiles_x, depth_order.order, ordered, counts, items)
        return TileLists(starts, items)

    def counts(self) -> OrderCounts:
        """Counts of the last frame."""
        return OrderCounts(self._visible, self._nonfinite, self._pairs.get("raster", 0))

    def overflowed(self) -> bool:
        """Whether a list was cut; never, as counts are known in time."""
        return False


class OrderParallel:
    """CUDA schedule: library radix sorts over capacities; nothing is read back while the frame runs.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._capacity: dict[str, int] = {}
        self._totals: dict[str, Any] = {}
        self.growth = 0
        """How often an overflow made lists larger: a graph captured before is stale."""
        self._key_counts = buffers.get("order.key_counts", wp.int32, 2)
        self._key_counts.zero_()

    def sort(self, keys: Any) -> DepthOrder:
        """Orders all items by key; the culled ones come last and have empty rectangles."""
        count = keys.shape[0]
        sorted_keys = self._buffers.get("order.keys", wp.uint32, 2 * count)
        order = self._buffers.get("order.indices", wp.int32, 2 * count)
        wp.copy(sorted_keys, keys, count=count)
        self._launcher.run(kernels.fill_identity, count, 0, order)
        wp.utils.radix_sort_pairs(sorted_keys, order, count)
        self._launcher.run(kernels.count_sorted_keys, 1, count, sorted_keys, self._key_counts)
        return DepthOrder(order, count)

    def unsorted(self, count: int) -> DepthOrder:
        """All items, in their own order."""
        order = self._buffers.get("order.identity", wp.int32, count)
        self._launcher.run(kernels.fill_identity, count, 0, order)
        return DepthOrder(order, count)

    def bin(self, name: str, depth_order: DepthOrder, rects: Any, tiles_x: int, tile_count: int) -> TileLists:
        """Lists the ordered items of each tile: (tile, item) pairs in depth order, sorted stably by tile."""
        run, buffers, count = self._launcher.run, self._buffers, depth_order.count
        capacity = self._capacity.setdefault(name, grown(2 * count))
        counts = buffers.get(f"{name}.counts", wp.int32, count + 1)
        offsets = buffers.get(f"{name}.offsets", wp.int32, count + 1)
        tiles = buffers.get(f"{name}.tiles", wp.int32, 2 * capacity)
        items = buffers.get(f"{name}.items", wp.int32, 2 * capacity)
        starts = buffers.get(f"{name}.starts", wp.int32, tile_count + 1)
        run(kernels.count_pairs, count + 1, 0, depth_order.order, rects, counts)
        wp.utils.array_scan(counts, offsets, inclusive=False)
        self._totals[name] = offsets[count : count + 1]
        run(kernels.clear_pairs, capacity, 0, tile_count, tiles)
        run(kernels.emit_pairs, count, 0, tiles_x, capacity, depth_order.order, rects, offsets, tiles, items)
        wp.utils.radix_sort_pairs(tiles, items, capacity, end_bit=tile_count.bit_length())
        run(kernels.find_tile_starts, tile_count + 1, 0, capacity, tiles, starts)
        return TileLists(starts, items)

    def counts(self) -> OrderCounts:
        """Counts of the last frame; waits for it."""
        visible, nonfinite = (int(value) for value in self._key_counts.numpy())
        pairs = int(self._totals["raster"].numpy()[0]) if "raster" in self._totals else 0
        return OrderCounts(visible, nonfinite, pairs)

    def overflowed(self) -> bool:
        """Whether the last frame's lists were cut; if so, makes room, and the frame has to be drawn again."""
        cut = False
        for name, total in self._totals.items():
            needed = int(total.numpy()[0])
            if needed > self._capacity[name]:
                self._capacity[name] = grown(needed)
                self.growth += 1
                cut = True
        return cut


def grown(count: int) -> int:
    """Capacity for ``count`` elements, in steps of up to a quarter, so that small changes do not reallocate."""
    step = 1 << max(10, count.bit_length() - 3)
    return -(-count // step) * step
