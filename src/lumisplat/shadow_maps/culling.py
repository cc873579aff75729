"""Culls casters that no light ray through a tile of the atlas intersects (docs/method/deep_shadow_maps.md#culling)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import SHADOW_TILE
from lumisplat.device.shadow_map.atlas import TILE_TEXELS, Atlas
from lumisplat.device.shadow_map.culling import CasterLists, Cell
from lumisplat.errors import SceneError
from lumisplat.math.arrays import IntArray
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels

SHADOW_BLOCK_TILES = 8
"""Side, in tiles, of the squares for which casters are culled before the single tiles: 256 squares in an atlas of
1024 x 1024 texels."""

BANDS_PER_THREAD = 16
"""Number of launches per CPU thread; each launch processes a range of cells. Many small ranges balance cells of
different cost: some have many casters, others none."""

PARALLEL_PARTS = 2**16
"""Total number of parts into which CUDA splits the caster lists of all cells. Each part has one thread, because cells
are few and lists are long.
"""


@dataclass(frozen=True, slots=True, eq=False)
class CulledCasters:
    """Lists, for each cell (a square of texels), the casters that light rays through the cell may intersect."""

    lists: CasterLists
    """For each cell, the indices of the casters that may shadow it; on the device."""
    counts: IntArray
    """Number of casters in the list of each cell."""


class OneList:
    """Stands in for culling when it is disabled: one list of all casters serves every texel.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers

    def cull(self, footprints: DeviceArray) -> CulledCasters:
        """Returns one list of all casters; ``footprints`` has one row for each caster."""
        return CulledCasters(list_of_all(self._buffers, footprints), np.array([footprints.shape[0]], np.int32))

    def list_numbers(self, texels: IntArray) -> IntArray:
        """Returns the index of each texel's caster list: always 0."""
        return np.zeros(len(texels), np.int32)


class TileLists:
    """Lists, for each tile (square of texels) of the atlas, the casters that light rays through it may intersect.

    Casters are culled for squares of tiles first, then for the tiles of each square.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        atlas: The atlas.
        tiles: Indices of the tiles, ascending.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, atlas: Atlas, tiles: IntArray) -> None:
        self._launcher, self._buffers, self._atlas = launcher, buffers, atlas
        self.tiles = tiles
        """Indices of the tiles that get lists, ascending."""
        across = atlas.size // SHADOW_TILE
        face, y, x = tiles // across**2, tiles // across % across, tiles % across
        blocks = np.stack([face, x // SHADOW_BLOCK_TILES, y // SHADOW_BLOCK_TILES], axis=1)
        blocks, parents = np.unique(blocks, axis=0, return_inverse=True)
        block_side = SHADOW_BLOCK_TILES * SHADOW_TILE
        all_casters = np.zeros(len(blocks), np.int32)
        self._blocks = self._cells("blocks", blocks * [1, block_side, block_side], block_side, all_casters)
        corners = np.stack([face, x * SHADOW_TILE, y * SHADOW_TILE], axis=1)
        self._tiles = self._cells("tiles", corners, SHADOW_TILE, parents.ravel())

    def cull(self, footprints: DeviceArray) -> CulledCasters:
        """Returns the caster list of each tile; ``footprints`` holds a row of Footprint for each caster."""
        lists = list_of_all(self._buffers, footprints)
        of_blocks = self._narrow("blocks", self._blocks, footprints, lists)
        return self._narrow("tiles", self._tiles, footprints, of_blocks.lists)

    def list_numbers(self, texels: IntArray) -> IntArray:
        """Returns the index of each texel's caster list; every texel must lie in one of ``tiles``."""
        return np.searchsorted(self.tiles, texels // TILE_TEXELS).astype(np.int32)

    def _narrow(self, name: str, cells: DeviceArray, footprints: DeviceArray, lists: CasterLists) -> CulledCasters:
        """Returns, for each cell, those casters of its parent's list that light rays through the cell may intersect.

        Cells are the squares that are culled next; ``lists`` holds the lists of the larger squares that contain them.
        """
        parts = max(PARALLEL_PARTS // max(cells.shape[0], 1), 1) if self._launcher.is_parallel else 1
        count, run = cells.shape[0] * parts, self._launcher.run_banded
        bands = BANDS_PER_THREAD * self._launcher.threads
        inputs = self._atlas, footprints, cells, lists, parts
        counts_out = self._buffers.get(f"{name}.counts", wp.int32, count)
        run(kernels.count_intersections, count, *inputs, counts_out, bands=bands)
        counts = counts_out.numpy()
        total = int(counts.sum(dtype=np.int64))
        if total >= 2**31:
            raise SceneError(f"{total:,} pairs of casters and tiles are too many: move the light away from casters")
        ends = np.cumsum(counts, dtype=np.int32)
        narrowed = CasterLists()
        narrowed.items = self._buffers.get(f"{name}.items", wp.int32, total)
        ends_of_parts = self._buffers.upload(f"{name}.ends_of_parts", wp.int32, ends)
        run(kernels.list_intersections, count, *inputs, ends_of_parts, narrowed.items, bands=bands)
        narrowed.ends = self._buffers.upload(f"{name}.ends", wp.int32, ends[parts - 1 :: parts])
        return CulledCasters(narrowed, counts.reshape(-1, parts).sum(axis=1, dtype=np.int32))

    def _cells(
        self, name: str, corners: npt.NDArray[np.integer], side: int, parents: npt.NDArray[np.integer]
    ) -> DeviceArray:
        """Returns rows of Cell (bounds of light rays) for squares of ``side`` texels.

        Args:
            name: Prefix of the buffers' names.
            corners: Face of the atlas, column and row of each square's first texel.
            side: Side of the squares, texels.
            parents: Index of the caster list of the larger square that contains each square.
        """
        cells = self._buffers.get(f"{name}.cells", Cell, len(corners))
        uploaded = (
            self._buffers.upload(f"{name}.corners", wp.vec3i, corners.astype(np.int32)),
            side,
            self._buffers.upload(f"{name}.parents", wp.int32, parents.astype(np.int32)),
        )
        self._launcher.run_banded(kernels.bound_cells, len(corners), self._atlas, *uploaded, cells)
        return cells


def list_of_all(buffers: Buffers, footprints: DeviceArray) -> CasterLists:
    """Returns one list with the indices of all casters."""
    lists = CasterLists()
    lists.items = buffers.upload("culling.items", wp.int32, np.arange(footprints.shape[0], dtype=np.int32))
    lists.ends = buffers.upload("culling.all", wp.int32, np.array([footprints.shape[0]], np.int32))
    return lists
