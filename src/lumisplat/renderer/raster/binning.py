"""Host passes that sort splats or triangles (items) by depth and list them per tile.

The CPU and CUDA run different kernels (schedules), which give the same result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import warp as wp

from lumisplat.constants import COUNT_SUM_THREADS, ITEMS_MAX
from lumisplat.device.structs.raster import ChunkData, TileRect
from lumisplat.errors import DeviceError
from lumisplat.renderer.raster import binning_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import copy_elements, prefix_sum, sort_pairs

SORT_DIGIT_BITS_MAX = 12
"""Largest number of bits per radix digit in the CPU's depth sort: 4096 counters per chunk stay in the L1 cache, and
two passes cover the usual 24 bits of a key."""


@dataclass(frozen=True, slots=True)
class DepthOrder:
    """Items (splats or triangles) in front-to-back order, sorted stably."""

    order: DeviceArray
    """Indices of splats or triangles in depth order; entries from ``count`` on are culled items or undefined."""
    count: int
    """Number of entries of ``order`` to list per tile. On CUDA the number includes culled items, because the number of
    visible items stays on the device."""


@dataclass(frozen=True, slots=True)
class BinningCounts:
    """Counts of the Gaussians of the last frame."""

    visible: int = 0
    """Number of Gaussians that may touch the image."""
    nonfinite: int = 0
    """Number of Gaussians dropped because a projected value was NaN or infinite."""
    pairs: int = 0
    """Number of (tile, Gaussian) pairs, the total length of the tile lists."""


@dataclass(frozen=True, slots=True)
class TileLists:
    """For each tile, the splats or triangles that touch it, in depth order."""

    starts: DeviceArray
    """Index in ``items`` of the first entry of each tile; the last element is the total number of entries. All are 0 if
    the lists are too short (`Binning.finish`)."""
    items: DeviceArray
    """Indices of the splats or triangles of each tile, tile after tile."""


class Binning(ABC):
    """Sorts splats or triangles (items) by depth and lists them per tile.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self.counts = BinningCounts()
        """Counts of the last finished frame."""
        self.growth = 0
        """Number of times that a tile list was too short and was enlarged. A CUDA graph recorded at another number is
        stale."""
        self.totals, self.limits = (buffers.get(f"order.{name}", wp.int64, 0) for name in ("totals", "limits"))
        """Counts of the frame on the device, ``int64``, and the largest ones with which its lists are complete; empty
        if lists are always complete."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    @abstractmethod
    def begin(self) -> None:
        """Starts a frame: resets ``counts``."""

    @abstractmethod
    def finish(self) -> bool:
        """Ends a frame; False if a tile list was too short. The list is then enlarged; draw the frame again."""

    @abstractmethod
    def sort(self, keys: DeviceArray) -> DepthOrder:
        """Returns splats or triangles sorted by depth key; culled ones come last or are dropped."""

    @abstractmethod
    def unsorted(self, count: int) -> DepthOrder:
        """Returns ``count`` splats or triangles in their original order, for passes that need no depth order."""

    @abstractmethod
    def bin(self, name: str, depth_order: DepthOrder, rects: DeviceArray, tiles_x: int, tile_count: int) -> TileLists:
        """Returns, for each tile, the splats or triangles (items) that touch it, in depth order.

        Args:
            name: Name of the list: ``raster`` or ``mesh``.
            depth_order: The items in depth order.
            rects: Rectangle of tiles that each item touches.
            tiles_x: Number of tiles across the image.
            tile_count: Number of tiles.
        """


class BinningChunked(Binning):
    """CPU schedule: counting sorts; each thread sorts one contiguous chunk of the splats or triangles."""

    def begin(self) -> None:
        """Starts a frame: resets ``counts``."""
        self._visible = self._nonfinite = 0
        self._pairs: dict[str, int] = {}

    def finish(self) -> bool:
        """Ends a frame, and returns True: lists are counted before they are written, so they are always complete."""
        self.counts = BinningCounts(self._visible, self._nonfinite, self._pairs.get("raster", 0))
        return True

    def sort(self, keys: DeviceArray) -> DepthOrder:
        """Returns the visible splats or triangles sorted by depth key; the radix sort's first pass drops the others."""
        run, buffers, chunks = self._launcher.run_banded, self._buffers, self._launcher.threads
        ranges = buffers.get("order.ranges", ChunkData, chunks)
        run(kernels.measure_keys, chunks, chunks, keys, ranges)
        measured = ranges.numpy()
        self._visible = visible = int(measured["visible"].sum())
        self._nonfinite = int(measured["nonfinite"].sum())
        capacity = keys.shape[0]
        sorted_keys = [buffers.get(f"order.keys{i}", wp.uint32, capacity) for i in (0, 1)]
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
            keys_out, order_out = sorted_keys[number % 2], order[number % 2]
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
        """Returns ``count`` splats or triangles in their original order, for passes that need no depth order."""
        order = self._buffers.get("order.identity", wp.int32, count)
        self._launcher.run_banded(kernels.fill_identity, count, order)
        return DepthOrder(order, count)

    def bin(self, name: str, depth_order: DepthOrder, rects: DeviceArray, tiles_x: int, tile_count: int) -> TileLists:
        """Returns, for each tile, the splats or triangles that touch it, in depth order, by a counting sort."""
        run, buffers, chunks = self._launcher.run_banded, self._buffers, self._launcher.threads
        count = depth_order.count
        counts = buffers.get("order.tiles", wp.int32, (chunks, tile_count))
        pairs = buffers.get("order.pairs", wp.int64, chunks)
        starts = buffers.get(f"{name}.starts", wp.int32, tile_count + 1)
        ordered = buffers.get("order.rects", TileRect, grown_capacity(count))
        run(kernels.count_tiles, chunks, chunks, count, tiles_x, depth_order.order, rects, counts, ordered, pairs)
        self._pairs[name] = total = check_pairs(int(pairs.numpy().sum()))
        self._launcher.run(kernels.scan_counts, 1, chunks, counts, starts)
        items = buffers.get(f"{name}.items", wp.int32, grown_capacity(total))
        run(kernels.scatter_tiles, chunks, chunks, count, tiles_x, depth_order.order, ordered, counts, items)
        return TileLists(starts, items)


class BinningParallel(Binning):
    """CUDA schedule: radix sorts of Warp's library. No count is read back before the frame ends.

    Sorts and scans therefore cover the capacities of lists instead of their lengths.
    """

    _SLOTS: ClassVar[dict[str, int]] = {"raster": 2, "mesh": 3}
    """Index in the array of totals at which the length of each list is stored, by the list's name. The first two
    totals are the numbers of visible and of non-finite Gaussians."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        super().__init__(launcher, buffers)
        self._capacity: dict[str, int] = {}
        counts = 2 + len(self._SLOTS)
        self.totals, self.limits = (buffers.get(f"order.{name}", wp.int64, counts) for name in ("totals", "limits"))

    def begin(self) -> None:
        """Starts a frame: resets ``counts``."""
        self.totals.zero_()

    def finish(self) -> bool:
        """Waits for the frame; False if a tile list was too short. The list is then enlarged; draw the frame again.

        Raises:
            DeviceError: A list is longer than 32-bit indices reach.
        """
        totals = [int(total) for total in self.totals.numpy()]
        self.counts = BinningCounts(*totals[:3])
        complete = True
        for name, slot in self._SLOTS.items():
            if check_pairs(totals[slot]) > self._capacity.get(name, 0):
                self._set_capacity(name, grown_capacity(totals[slot]))
                self.growth += 1
                complete = False
        return complete

    def _set_capacity(self, name: str, capacity: int) -> None:
        self._capacity[name] = capacity
        of_lists = [self._capacity.get(one, ITEMS_MAX) for one in self._SLOTS]
        self.limits.assign(np.array([ITEMS_MAX, ITEMS_MAX, *of_lists], np.int64))

    def sort(self, keys: DeviceArray) -> DepthOrder:
        """Returns all splats or triangles sorted by depth key; culled ones come last and touch no tile."""
        count = keys.shape[0]
        sorted_keys = self._buffers.get("order.keys", wp.uint32, 2 * count)
        order = self._buffers.get("order.indices", wp.int32, 2 * count)
        copy_elements(keys, sorted_keys, count)
        self._launcher.run(kernels.fill_identity, count, 0, order)
        sort_pairs(sorted_keys, order, count)
        self._launcher.run(kernels.count_sorted_keys, 1, count, sorted_keys, self.totals)
        return DepthOrder(order, count)

    def unsorted(self, count: int) -> DepthOrder:
        """Returns ``count`` splats or triangles in their original order, for passes that need no depth order."""
        order = self._buffers.get("order.identity", wp.int32, count)
        self._launcher.run(kernels.fill_identity, count, 0, order)
        return DepthOrder(order, count)

    def bin(self, name: str, depth_order: DepthOrder, rects: DeviceArray, tiles_x: int, tile_count: int) -> TileLists:
        """Returns, for each tile, the splats or triangles that touch it, by sorting (tile, item) pairs by tile.

        The pairs are made in depth order, and the sort is stable.
        """
        run, buffers, count = self._launcher.run, self._buffers, depth_order.count
        if name not in self._capacity:
            self._set_capacity(name, grown_capacity(2 * count))
        capacity = self._capacity[name]
        counts = buffers.get(f"{name}.counts", wp.int32, count + 1)
        offsets = buffers.get(f"{name}.offsets", wp.int32, count + 1)
        tiles = buffers.get(f"{name}.tiles", wp.int32, 2 * capacity)
        items = buffers.get(f"{name}.items", wp.int32, 2 * capacity)
        starts = buffers.get(f"{name}.starts", wp.int32, tile_count + 1)
        run(kernels.count_pairs, count + 1, 0, depth_order.order, rects, None, counts)
        prefix_sum(counts, offsets, inclusive=False)
        run(kernels.sum_pairs, COUNT_SUM_THREADS, 0, counts, self._SLOTS[name], self.totals)
        run(kernels.clear_pairs, capacity, 0, tile_count, tiles)
        run(kernels.emit_pairs, count, 0, tiles_x, capacity, depth_order.order, rects, offsets, tiles, items)
        sort_pairs(tiles, items, capacity, bits=tile_count.bit_length())
        run(kernels.find_tile_starts, tile_count + 1, 0, capacity, self._SLOTS[name], self.totals, tiles, starts)
        listed = items[:capacity] if capacity else items  # the rest is scratch space of the sort
        return TileLists(starts, device_array(listed))


def binning_of(launcher: Launcher, buffers: Buffers) -> Binning:
    """Returns the object that sorts and lists splats on a device: chunked on the CPU, parallel on CUDA."""
    return (BinningParallel if launcher.is_parallel else BinningChunked)(launcher, buffers)


def pair_starts(launcher: Launcher, buffers: Buffers, rects: DeviceArray, tile_starts: DeviceArray) -> DeviceArray:
    """Returns where the (tile, item) pairs of each splat or triangle begin in a list of all pairs, item by item.

    The last element is the number of pairs. It is 0 if a tile list was too short, because all lists are then empty.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays.
        rects: Rectangle of tiles that each item touches.
        tile_starts: ``starts`` of the `TileLists` of the items.
    """
    count = rects.shape[0]
    counts, starts = (buffers.get(f"order.item_{kind}", wp.int32, count + 1) for kind in ("counts", "starts"))
    launcher.run_banded(kernels.count_pairs, count + 1, None, rects, tile_starts, counts)
    prefix_sum(counts, starts, inclusive=False)
    return starts


def check_pairs(count: int) -> int:
    """Returns ``count``, the number of (tile, item) pairs, if it fits 32-bit indices.

    Raises:
        DeviceError: The number does not fit 32-bit indices.
    """
    if count > ITEMS_MAX:
        raise DeviceError(
            f"the frame needs {count:,} pairs of a tile and a splat or triangle, more than {ITEMS_MAX:,}: "
            "render a smaller image"
        )
    return count
