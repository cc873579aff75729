"""Which casters the rays through a tile of an atlas can meet (docs/method/deep_shadow_maps.md#culling)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import SHADOW_BLOCK_TILES, SHADOW_TILE
from lumisplat.device.shadow_map.atlas import TILE_TEXELS, Atlas
from lumisplat.device.structs.shadow_map import Cell
from lumisplat.errors import SceneError
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels

_Ints = npt.NDArray[np.int32]

BANDS_PER_THREAD = 16
"""Cells differ much in cost: where casters are, or none."""


class OneList:
    """All casters for every ray: without culling.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self.ends: Any = None
        """Where the list ends."""
        self.items: Any = None
        """Numbers of the casters."""
        self.counts: _Ints = np.zeros(1, np.int32)
        """How many casters there are, shape (1,)."""

    def update(self, footprints: Any) -> None:
        """Lists as many casters as there are footprints."""
        self.ends, self.items = list_of_all(self._buffers, footprints)
        self.counts[0] = self.items.shape[0]

    def of_texels(self, texels: _Ints) -> _Ints:
        """The number of each texel's list."""
        return np.zeros(len(texels), np.int32)


class TileLists:
    """For each of some tiles, the casters that its rays can meet: looked for in blocks of tiles first, then in tiles.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        atlas: What the tiles are of.
        tiles: Their numbers, ascending, shape (T,).
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, atlas: Atlas, tiles: _Ints) -> None:
        self._launcher, self._buffers, self._atlas = launcher, buffers, atlas
        self.tiles = tiles
        across = atlas.size // SHADOW_TILE
        face, y, x = tiles // across**2, tiles // across % across, tiles % across
        blocks = np.stack([face, x // SHADOW_BLOCK_TILES, y // SHADOW_BLOCK_TILES], axis=1)
        blocks, parents = np.unique(blocks, axis=0, return_inverse=True)
        block_side, none = SHADOW_BLOCK_TILES * SHADOW_TILE, np.zeros(len(blocks), np.int32)
        self._blocks = self._cells("blocks", blocks * [1, block_side, block_side], block_side, none)
        corners = np.stack([face, x * SHADOW_TILE, y * SHADOW_TILE], axis=1)
        self._tiles = self._cells("tiles", corners, SHADOW_TILE, parents.ravel())
        self.ends: Any = None
        """Where the list of each tile ends, and the next one's begins."""
        self.items: Any = None
        """The lists, one after another: numbers of casters, ascending in each."""
        self.counts: _Ints = np.zeros(len(tiles), np.int32)
        """How many casters each tile can meet, shape (T,)."""

    def update(self, footprints: Any) -> None:
        """Looks casters up anew, by what each of them covers."""
        ends, items = list_of_all(self._buffers, footprints)
        ends, items, _ = self._narrow("blocks", self._blocks, footprints, ends, items)
        self.ends, self.items, self.counts = self._narrow("tiles", self._tiles, footprints, ends, items)

    def of_texels(self, texels: _Ints) -> _Ints:
        """The number of each texel's list, in tiles that there are."""
        return np.searchsorted(self.tiles, texels // int(TILE_TEXELS)).astype(np.int32)

    def _narrow(self, name: str, cells: Any, footprints: Any, ends: Any, items: Any) -> tuple[Any, Any, _Ints]:
        """Of the casters in the lists of their parents, those that cells meet."""
        count, run = cells.shape[0], self._launcher.run_banded
        bands = BANDS_PER_THREAD * self._launcher.threads
        counts = self._buffers.get(f"{name}.counts", wp.int32, count)
        run(kernels.count_met, count, self._atlas, footprints, cells, ends, items, counts, bands=bands)
        met = counts.numpy()
        total = int(met.sum(dtype=np.int64))
        if total >= 2**31:
            raise SceneError(f"{total:,} pairs of casters and tiles are too many: move the light off the casters")
        ends_out = self._buffers.get(f"{name}.ends", wp.int32, count)
        ends_out.assign(np.cumsum(met, dtype=np.int32))
        items_out = self._buffers.get(f"{name}.items", wp.int32, total)
        run(kernels.list_met, count, self._atlas, footprints, cells, ends, items, ends_out, items_out, bands=bands)
        return ends_out, items_out, met

    def _cells(self, name: str, corners: np.ndarray, side: int, parents: np.ndarray) -> Any:
        cells = self._buffers.get(f"{name}.cells", Cell, len(corners))
        rows = np.zeros(len(corners), dtype=np.dtype(Cell.numpy_dtype()))  # type: ignore[attr-defined]
        rows["parent"] = parents
        cells.assign(rows)
        uploaded = self._buffers.get(f"{name}.corners", wp.vec3i, len(corners))
        uploaded.assign(corners.astype(np.int32))
        self._launcher.run_banded(kernels.bound_cells, len(corners), self._atlas, uploaded, side, cells)
        return cells


def list_of_all(buffers: Buffers, footprints: Any) -> tuple[Any, Any]:
    """Where the one list of all casters ends, and their numbers."""
    count = footprints.shape[0]
    items = buffers.get("culling.items", wp.int32, count)
    items.assign(np.arange(count, dtype=np.int32))
    ends = buffers.get("culling.all", wp.int32, 1)
    ends.fill_(count)
    return ends, items
