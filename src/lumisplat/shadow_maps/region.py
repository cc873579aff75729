"""What of an atlas is tabulated: a column of bins for some of its texels (docs/method/deep_shadow_maps.md#region)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import SHADOW_BLOCKING_REACH
from lumisplat.device.shadow_map.atlas import PARALLEL, TILE_TEXELS, Atlas
from lumisplat.device.structs.shadow_map import Column, Look, Receivers
from lumisplat.errors import SceneError
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.ops.world_gaussians import PlacedGaussians
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels
from lumisplat.shadow_maps.atlas import face_count
from lumisplat.shadow_maps.culling import OneList, TileLists

_Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Region:
    """Texels and bins that are tabulated; transmittance is 1 in others."""

    texels: _Ints
    """Numbers of the texels that have a column, ascending, shape (P,)."""
    first: _Ints
    """First bin of each, shape (P,)."""
    count: _Ints
    """Number of bins of each, shape (P,)."""

    @property
    def voxel_count(self) -> int:
        """Bins over all texels."""
        return int(self.count.sum(dtype=np.int64))

    @property
    def tiles(self) -> _Ints:
        """Numbers of the tiles that have such texels, ascending."""
        return np.unique(self.texels // int(TILE_TEXELS))

    def columns(self, atlas: Atlas) -> tuple[_Ints, np.ndarray]:
        """The slot of each tile, and rows of Column for the texels of each slot, as in Table.

        Raises:
            SceneError: There are more bins than can be numbered.
        """
        if self.voxel_count >= 2**31:
            raise SceneError(
                f"a deep shadow map of {self.voxel_count:,} bins is too large: give receivers, or lower its resolution"
            )
        tiles, per_tile = self.tiles, int(TILE_TEXELS)
        slots = np.full(texel_count(atlas) // per_tile, -1, np.int32)
        slots[tiles] = np.arange(len(tiles))
        rows = np.zeros(len(tiles) * per_tile, dtype=np.dtype(Column.numpy_dtype()))  # type: ignore[attr-defined]
        places = slots[self.texels // per_tile] * per_tile + self.texels % per_tile
        rows["first"][places], rows["count"][places] = self.first, self.count
        rows["offset"][places] = np.cumsum(self.count) - self.count
        return slots, rows


def texel_count(atlas: Atlas) -> int:
    """Texels over all faces."""
    return face_count(atlas) * atlas.size**2


def whole_region(atlas: Atlas) -> Region:
    """All texels and bins."""
    count = texel_count(atlas)
    return Region(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), np.full(count, atlas.bins, np.int32))


def all_tiles(atlas: Atlas) -> _Ints:
    """The numbers of all tiles."""
    return np.arange(texel_count(atlas) // int(TILE_TEXELS), dtype=np.int32)


def region_of_casters(atlas: Atlas, casters: PlacedGaussians, lists: TileLists | OneList) -> Region:
    """All that can be shadowed: the texels of tiles that casters reach, from the nearest to the farthest of them."""
    if isinstance(lists, OneList):
        return whole_region(atlas)
    if atlas.layout == int(PARALLEL):
        first, last = 0, atlas.bins - 1
    else:
        distances = np.linalg.norm(casters.means - np.array(atlas.origin), axis=1)
        reach = SHADOW_BLOCKING_REACH * casters.scales.max(axis=1)
        first, last = (int(t / atlas.bin_length - 0.5) for t in ((distances - reach).min(), (distances + reach).max()))
        first, last = max(first, 0), min(last + 1, atlas.bins - 1)
    texels = lists.tiles[lists.counts > 0, None] * int(TILE_TEXELS) + np.arange(int(TILE_TEXELS))
    texels = texels.ravel().astype(np.int32)
    return Region(texels, np.full(len(texels), first, np.int32), np.full(len(texels), last - first + 1, np.int32))


def region_of_receivers(launcher: Launcher, atlas: Atlas, receivers: Receivers, rows: _Ints, look: Look) -> Region:
    """What some ``rows`` of receivers read, and no more."""
    buffers = Buffers(launcher.device)  # of all texels, and not needed again
    firsts = buffers.get("region.firsts", wp.int32, texel_count(atlas))
    lasts = buffers.get("region.lasts", wp.int32, texel_count(atlas))
    firsts.fill_(atlas.bins)
    lasts.fill_(-1)
    uploaded = buffers.get("region.rows", wp.int32, len(rows))
    uploaded.assign(rows)
    # Not banded: the CPU's atomics are not atomic across threads.
    launcher.run(kernels.mark_looks, len(rows), atlas, receivers, uploaded, look, firsts, lasts)
    first, last = firsts.numpy(), lasts.numpy()
    texels = np.flatnonzero(last >= 0).astype(np.int32)
    return Region(texels, first[texels].copy(), last[texels] - first[texels] + 1)
