"""The part of an atlas that is tabulated: columns of bins for some texels (docs/method/deep_shadow_maps.md#region)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.constants import SHADOW_BLOCKING_REACH
from lumisplat.device.shadow_map.atlas import TILE_TEXELS
from lumisplat.device.structs.shadow_map import PARALLEL, Atlas, Column, FootprintSampling, Receivers
from lumisplat.errors import SceneError
from lumisplat.math.arrays import IntArray
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.ops.world_space import PlacedGaussians
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels
from lumisplat.shadow_maps.atlas import face_count


@dataclass(frozen=True, slots=True)
class Region:
    """Texels and bins that are tabulated; transmittance is 1 in others."""

    texels: IntArray
    """Numbers of the texels that have a column, ascending, shape (P,)."""
    first: IntArray
    """First bin of each, shape (P,)."""
    count: IntArray
    """Number of bins of each, shape (P,)."""

    @property
    def voxel_count(self) -> int:
        """Bins over all texels."""
        return int(self.count.sum(dtype=np.int64))

    @property
    def tiles(self) -> IntArray:
        """Numbers of the tiles that have such texels, ascending."""
        return np.unique(self.texels // TILE_TEXELS)

    def columns(self, atlas: Atlas) -> tuple[IntArray, npt.NDArray[np.void]]:
        """The slot of each tile, and rows of Column for the texels of each slot, as in `Table`.

        Raises:
            SceneError: There are more bins than can be numbered.
        """
        if self.voxel_count >= 2**31:
            raise SceneError(
                f"a deep shadow map of {self.voxel_count:,} bins is too large: give receivers, or lower its resolution"
            )
        tiles = self.tiles
        slots = np.full(texel_count(atlas) // TILE_TEXELS, -1, np.int32)
        slots[tiles] = np.arange(len(tiles))
        rows = np.zeros(len(tiles) * TILE_TEXELS, dtype=table_dtype(Column))
        places = slots[self.texels // TILE_TEXELS] * TILE_TEXELS + self.texels % TILE_TEXELS
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


def all_tiles(atlas: Atlas) -> IntArray:
    """The numbers of all tiles."""
    return np.arange(texel_count(atlas) // TILE_TEXELS, dtype=np.int32)


def region_of_casters(atlas: Atlas, casters: PlacedGaussians, tiles: IntArray) -> Region:
    """All that can be shadowed: the texels of ``tiles``, from the nearest of the casters to the farthest."""
    if atlas.layout == PARALLEL:
        first, last = 0, atlas.bins - 1
    else:
        distances = np.linalg.norm(casters.means - np.array(atlas.origin), axis=1)
        reach = SHADOW_BLOCKING_REACH * casters.scales.max(axis=1)
        first, last = (int(t / atlas.bin_length - 0.5) for t in ((distances - reach).min(), (distances + reach).max()))
        first, last = max(first, 0), min(last + 1, atlas.bins - 1)
    texels = (tiles[:, None] * TILE_TEXELS + np.arange(TILE_TEXELS)).ravel().astype(np.int32)
    return Region(texels, np.full(len(texels), first, np.int32), np.full(len(texels), last - first + 1, np.int32))


def region_of_receivers(
    launcher: Launcher, atlas: Atlas, receivers: Receivers, rows: IntArray, sampling: FootprintSampling
) -> Region:
    """What the lookups of some ``rows`` of receivers read, and no more."""
    buffers = Buffers(launcher.device)  # of all texels, and not needed again
    firsts = buffers.get("region.firsts", wp.int32, texel_count(atlas))
    lasts = buffers.get("region.lasts", wp.int32, texel_count(atlas))
    firsts.fill_(atlas.bins)
    lasts.fill_(-1)
    uploaded = buffers.upload("region.rows", wp.int32, rows)
    # Not banded: the CPU's atomics are not atomic across threads.
    launcher.run(kernels.mark_bins, len(rows), atlas, receivers, uploaded, sampling, firsts, lasts)
    first, last = firsts.numpy(), lasts.numpy()
    texels = np.flatnonzero(last >= 0).astype(np.int32)
    return Region(texels, first[texels].copy(), last[texels] - first[texels] + 1)
