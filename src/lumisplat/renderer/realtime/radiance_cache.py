"""World-space cache of reflected radiance (docs/method/realtime.md#radiance-cache).

In each frame, call `RadianceCache.insert` with the hits of rays, and `look_up` for the radiance at hits. Trace a ray
from each of `bounce_points`, insert its hit and call `add_bounces`. At the end of the frame, call `evict`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RadianceCacheConfig
from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.radiance_cache import (
    COUNT_DROPPED,
    COUNT_EVICTED,
    COUNT_EXCESS,
    COUNT_NEW,
    COUNTS,
    TILE_CELLS,
    TILE_MEANS,
    CacheGrid,
    CachePoints,
    CacheSamples,
    CacheTiles,
    SortedSamples,
)
from lumisplat.renderer.realtime import radiance_cache_kernels as kernels
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.downloads import HostCopy
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher
from lumisplat.runtime.primitives import copy_elements, prefix_sum, sort_pairs

BOUNCES_PER_RAY = 4
"""Number of times per frame that radiance is passed from cell to cell along the same rays. Each time, the cells hold
one more bounce of light, and a look-up costs much less than a ray."""

_log = logging.getLogger("lumisplat")

HISTORY_CUDA, HISTORY_CPU = 16, 32
"""Default number of frames over which a cell of the radiance cache averages: 16 on CUDA, 32 on the CPU."""

_STAGE = "cache"


class RadianceCache:
    """Cells in world space; each cell stores the mean radiance that the surfaces in the cell reflect.

    A tile is a square of 8 x 8 cells that are stored together in a slot of the arrays. Frame numbers never decrease.
    Methods read the number of the frame from ``sequence``, an array of one SequenceData.
    Array sizes depend on the settings and the samples of a frame; nothing grows with the number of frames.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: The settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RadianceCacheConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        history = config.history or (HISTORY_CUDA if launcher.is_cuda else HISTORY_CPU)
        self.grid = CacheGrid()
        """Settings as kernels need them."""
        self.grid.cell_size, self.grid.tiles = config.cell_size, config.tiles
        self.grid.history, self.grid.samples_min = float(history), float(min(config.samples_min, history))
        self.grid.bounce_history = float(config.bounce_history)
        self.tiles = _allocated_tiles(buffers, config.tiles)
        """Tiles (8 x 8 cells each) in use; the arrays have room for as many tiles as the settings allow."""
        self._counts = HostCopy(device_array(self.tiles.counts))
        self._has_warned = False

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def reset(self) -> None:
        """Empties the cache; must be called before the first frame."""
        self._launcher.run_banded(kernels.clear_tiles, self._config.tiles, self.tiles)
        self._counts.update()
        self._launcher.synchronize()  # otherwise the next frame could warn of the tiles of an earlier sequence
        self._has_warned = False

    def outdate(self, sequence: DeviceArray) -> None:
        """Multiplies the weight of all stored means by the history weight, because the light has changed."""
        with self._launcher.stage(_STAGE):
            self._launcher.run_banded(kernels.outdate_means, self._config.tiles * TILE_MEANS, sequence, self.tiles)

    def insert(self, samples: CacheSamples, sequence: DeviceArray) -> None:
        """Adds the direct radiance of a frame's samples to the means of their cells.

        Several calls with one frame number count as one frame. Samples that are not finite are dropped.
        """
        count = len(device_array(samples.is_active))
        if count:
            with self._launcher.stage(_STAGE):
                sorted_samples = self._sorted(samples, count)
                self._make_tiles(sorted_samples, count, sequence)
                run, tiles = self._launcher.run_banded, self.tiles
                run(kernels.add_samples, count, sequence, self.grid, samples, sorted_samples, tiles)
                run(kernels.update_tiles, count, sorted_samples, tiles)

    def look_up(self, samples: CacheSamples) -> DeviceArray:
        """Returns the linear radiance, of all bounces, that each sample's surface reflects; vec3, 0 if inactive.

        The next look-up of the same number of samples overwrites the result.
        """
        return self._look_up("radiance", samples)

    def look_up_indirect(self, samples: CacheSamples, points: DeviceArray | None = None) -> DeviceArray:
        """Returns the radiance that each sample's surface reflects, of light from other surfaces only; linear vec3.

        Args:
            samples: The surfaces.
            points: Points at which to look up, in the planes of the surfaces; random points hide the edges of cells. If
                a point's cell is empty, or if ``points`` is None, the sample's position is used instead.
        """
        count = len(device_array(samples.is_active))
        radiance = self._get("indirect", wp.vec3, count)
        with self._launcher.stage(_STAGE):
            inputs = self.grid, samples, points, self.tiles, radiance
            self._launcher.run_banded(kernels.look_up_indirect, count, *inputs)
        return radiance

    def cell_numbers(self, samples: CacheSamples) -> DeviceArray:
        """Returns an identifying hash of each sample's cell, 0..2^24 - 1; -1 if the sample has no cell."""
        count = len(device_array(samples.is_active))
        numbers = self._get("cell_numbers", wp.int32, count)
        with self._launcher.stage(_STAGE):
            self._launcher.run_banded(kernels.number_cells, count, self.grid, samples, self.tiles, numbers)
        return numbers

    def bounce_points(self, sequence: DeviceArray) -> CachePoints:
        """Returns ray origins in the cells that have waited longest since their last ray.

        Each cell gets one ray, or several if cells are few. The caller traces a cosine-weighted ray from each point,
        inserts the hits, and passes them to `add_bounces`. The number of points is fixed by the settings. Short rays
        hit fine cells, long rays coarse cells. Fine cells get one point each. Together they get more than half of all
        points only if coarse cells cannot use the rest. Only whole tiles are listed; the remaining points are inactive.
        """
        run, buffers, tiles = self._launcher.run_banded, self._buffers, self.tiles
        points = buffers.struct("radiance_cache.points", CachePoints, self._config.bounces)
        with self._launcher.stage(_STAGE):
            ranks = self._ranks(kernels.key_tiles_by_bounce)
            near, near_ends, far, far_ends = (self._per_tile(name) for name in ("near", "near_ends", "far", "far_ends"))
            run(kernels.count_cells, self._config.tiles, tiles, ranks, near, far)
            prefix_sum(near, near_ends, inclusive=True)
            prefix_sum(far, far_ends, inclusive=True)
            run(kernels.list_points, self._config.bounces, sequence, tiles, ranks, near_ends, far_ends, points)
        return points

    def add_bounces(
        self, points: CachePoints, hits: CacheSamples, radiance_of: Callable[[DeviceArray], DeviceArray] | None = None
    ) -> None:
        """Adds the radiance that cells receive along their rays, repeatedly, so that each ray carries several bounces.

        Args:
            points: Result of the last `bounce_points`; points of evicted tiles are ignored.
            hits: Hit of the ray from each point, already inserted; inactive: no light arrives along the ray.
            radiance_of: Converts radiance reflected at the hits to the radiance of the rays, linear, vec3; None: the
                rays have the radiance that is reflected at the hits.
        """
        run, count, tiles = self._launcher.run_banded, self._config.bounces, self.tiles
        means = self._get("means_before", wp.vec4, count)
        with self._launcher.stage(_STAGE):
            run(kernels.copy_means, count, points, tiles, means)
        for _ in range(BOUNCES_PER_RAY):
            reflected = self._look_up("reflected", hits)
            radiance = radiance_of(reflected) if radiance_of else reflected
            with self._launcher.stage(_STAGE):
                run(kernels.add_bounces, count, self.grid, points, means, radiance, tiles)
                run(kernels.update_bounced_tiles, count, points, tiles)

    def evict(self, sequence: DeviceArray) -> None:
        """Ends a frame: evicts the tiles that no ray has hit for ``unused_frames`` of the settings."""
        with self._launcher.stage(_STAGE):
            stays = self._per_tile("stays")
            inputs = sequence, self._config.unused_frames, self.tiles, stays
            self._launcher.run_banded(kernels.mark_used, self._config.tiles, *inputs)
            self._compact(stays, is_early=False)
        if not self._launcher.is_recording:
            self.warn_of_overflow()

    def _sorted(self, samples: CacheSamples, count: int) -> SortedSamples:
        """Sorts samples by tile, then by cell in the tile, then by index."""
        run, get = self._launcher.run_banded, self._get
        keys, cells = get("keys", wp.int64, count), get("cells", wp.int32, count)
        sort_cells = get("sort_cells", wp.int32, 2 * count)
        result = SortedSamples()
        result.keys, result.order = get("sorted_keys", wp.int64, 2 * count), get("order", wp.int32, 2 * count)
        result.cells = cells
        run(kernels.find_cells, count, self.grid, samples, keys, cells, sort_cells, result.order)
        sort_pairs(sort_cells, device_array(result.order), count, bits=TILE_CELLS.bit_length() - 1)
        run(kernels.gather_keys, count, keys, result.order, result.keys)
        sort_pairs(device_array(result.keys), device_array(result.order), count)
        return result

    def _make_tiles(self, samples: SortedSamples, count: int, sequence: DeviceArray) -> None:
        """Creates the tiles that samples need; if the cache is full, new tiles replace the tiles unused for longest."""
        run, tiles, capacity = self._launcher.run_banded, self.tiles, self._config.tiles
        is_new, ends = self._get("is_new", wp.int32, count), self._get("new_ends", wp.int32, count)
        run(kernels.find_new_tiles, count, sequence, samples, tiles, is_new)
        prefix_sum(is_new, ends, inclusive=True)
        self._launcher.run(kernels.count_new_tiles, 1, count, self.grid, ends, tiles)
        if self._may_count(COUNT_EXCESS):
            stays = self._per_tile("stays")
            ranks = self._ranks(kernels.key_tiles_by_use)
            run(kernels.mark_all_but_excess, capacity, sequence, tiles, ranks, stays)
            self._compact(stays, is_early=True)
        if self._may_count(COUNT_NEW):
            new_keys = self._get("new_keys", wp.int64, count)
            run(kernels.list_new_tiles, count, samples, is_new, ends, new_keys)
            keys, slots = self._spare_lists()
            run(kernels.merge_tiles, capacity, sequence, tiles, new_keys, keys, slots)
            self._replace_lists(keys, slots)
            self._launcher.run(kernels.count_merged_tiles, 1, tiles)

    def _compact(self, stays: DeviceArray, *, is_early: bool) -> None:
        """Evicts the tiles that are not marked in ``stays``.

        ``is_early``: tiles are evicted because the cache is full, not because they are unused; the kernel counts them.
        """
        ends = self._per_tile("ends")
        prefix_sum(stays, ends, inclusive=True)
        keys, slots = self._spare_lists()
        self._launcher.run_banded(kernels.compact_tiles, self._config.tiles, self.tiles, stays, ends, keys, slots)
        self._replace_lists(keys, slots)
        self._launcher.run(kernels.count_remaining_tiles, 1, is_early, self.grid, ends, self.tiles)

    def _look_up(self, name: str, samples: CacheSamples) -> DeviceArray:
        """Looks samples up like ``look_up``, and returns the radiance in the array called ``name``."""
        count = len(device_array(samples.is_active))
        radiance = self._get(name, wp.vec3, count)
        with self._launcher.stage(_STAGE):
            self._launcher.run_banded(kernels.look_up_samples, count, self.grid, samples, self.tiles, radiance)
        return radiance

    def _ranks(self, key_tiles: Kernel) -> DeviceArray:
        """Returns the tiles sorted by a number that kernel ``key_tiles`` writes for each; equal numbers by tile key."""
        count = self._config.tiles
        ages, ranks = (self._get(name, wp.int32, 2 * count) for name in ("ages", "ranks"))
        self._launcher.run_banded(key_tiles, count, self.tiles, ages, ranks)
        sort_pairs(ages, ranks, count)
        return ranks

    def _spare_lists(self) -> tuple[DeviceArray, DeviceArray]:
        """Returns the spare arrays into which the next lists of tiles' keys and storage slots are written."""
        return self._get("other_keys", wp.int64, self._config.tiles), self._per_tile("other_slots")

    def _replace_lists(self, keys: DeviceArray, slots: DeviceArray) -> None:
        """Copies new lists of tiles' keys and storage slots over the current ones."""
        copy_elements(keys, device_array(self.tiles.keys), self._config.tiles)
        copy_elements(slots, device_array(self.tiles.slots), self._config.tiles)

    def _may_count(self, index: int) -> bool:
        """Returns whether a counter is above 0; always True on a GPU, where empty passes cost less than a download."""
        return self._launcher.is_parallel or bool(device_array(self.tiles.counts).numpy()[index] > 0)

    def warn_of_overflow(self) -> None:
        """Warns once if the cache was full, so that tiles were evicted early or could not be added.

        Does not wait for the device, whose last two frames may be missing.
        """
        if not self._has_warned:
            self._counts.update()
            counts = self._counts.values
            if np.any(counts[[COUNT_EVICTED, COUNT_DROPPED]] > 0):
                self._has_warned = True
                _log.warning(
                    "the radiance cache is full: %s tiles were evicted, %s could not be added; "
                    "set realtime.cache.tiles above %s",
                    *(f"{number:,}" for number in (*counts[[COUNT_EVICTED, COUNT_DROPPED]], self._config.tiles)),
                )

    def _per_tile(self, name: str) -> DeviceArray:
        """Returns a scratch array called ``name`` with one integer for each tile."""
        return self._get(name, wp.int32, self._config.tiles)

    def _get(self, name: str, dtype: type[object], count: int) -> DeviceArray:
        return self._buffers.get(f"radiance_cache.{name}", dtype, count)


_CELL_FIELDS = ("frames", "updated", "position", "normal", "extent")
"""Fields of CacheTiles that have one element for each cell of a tile."""

_LENGTHS = {"direct": TILE_MEANS, "indirect": TILE_MEANS, "arrived": TILE_CELLS * GRID_LIGHTS} | dict.fromkeys(
    _CELL_FIELDS, TILE_CELLS
)
"""Number of elements per tile in each array of CacheTiles; 1 for arrays that are not listed."""


def _allocated_tiles(buffers: Buffers, capacity: int) -> CacheTiles:
    """Allocates arrays for ``capacity`` tiles. On CPUs, the operating system commits the memory on first write."""
    struct_type: Any = CacheTiles
    tiles = CacheTiles()
    for field, variable in struct_type.vars.items():
        count = COUNTS if field == "counts" else capacity * _LENGTHS.get(field, 1)
        setattr(tiles, field, buffers.get(f"radiance_cache.tiles.{field}", variable.type.dtype, count))
    return tiles
