"""Atlas (texel layout) of a light's deep shadow map, and the region of texels and depth bins that is tabulated.

Source: docs/method/deep_shadow_maps.md#region.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import AtlasLayout, DeepShadowConfig
from lumisplat.constants import SHADOW_BOUND_MARGIN, SHADOW_FOOTPRINT, SHADOW_TILE
from lumisplat.device.shadow_map.atlas import (
    CUBEMAP,
    EVERYTHING,
    NOTHING,
    OCTAHEDRAL,
    PARALLEL,
    SOMETHING,
    TILE_TEXELS,
    Atlas,
)
from lumisplat.device.shadow_map.lookup import FootprintSampling, Receivers, ShadowBound
from lumisplat.device.shadow_map.optical_depth import Column
from lumisplat.errors import SceneError
from lumisplat.math.arrays import IntArray
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.scene.lights import LightDirectional, PlacedLight, vector
from lumisplat.scene.local_frame import PlacedGaussians
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels

SHADOW_BLOCKING_REACH = 6.0
"""A Gaussian blocks no light farther than this many standard deviations from its mean: erfc(6 / sqrt(2)) is 2e-9."""

Source = npt.NDArray[np.float64] | LightDirectional
"""Position of a point light, shape (3,), or a directional light."""


def source_of(light: object) -> Source:
    """Returns the position or direction of a light; a point of shape (3,) may be given instead of a light.

    Raises:
        SceneError: The argument is neither a point nor a light with a position or direction, or is not finite.
    """
    if isinstance(light, LightDirectional):
        return light
    if isinstance(light, PlacedLight):
        return np.array(light.position, dtype=np.float64)
    if not isinstance(light, list | tuple | np.ndarray):
        raise SceneError(
            f"light_position is a {type(light).__name__}, expected a point (3,) or a light with position or direction"
        )
    return np.array(vector("light_position", cast("npt.ArrayLike", light)))


def atlas_of(source: Source, around: PlacedGaussians, config: DeepShadowConfig) -> Atlas:
    """Fits the atlas of a light to Gaussians.

    Args:
        source: Position or direction of the light.
        around: The receivers, or the casters if there are no receivers. The depth bins cover these Gaussians; the texel
            plane of a directional light covers them, too.
        config: Settings.
    """
    atlas = Atlas()
    atlas.bins = config.bins
    if isinstance(source, LightDirectional):
        _fit_plane(atlas, source, around, config)
    else:
        _fit_sphere(atlas, source, around, config)
    return atlas


def shadow_bound(atlas: Atlas, footprints: npt.NDArray[np.void] | None) -> ShadowBound:
    """Returns a volume that contains all points that casters can shadow: a cone for a point light, else a cylinder.

    Args:
        atlas: The light's atlas.
        footprints: Row of Footprint for each caster; None: the casters are unknown, and the volume is all of space.
    """
    bound = ShadowBound()
    bound.extent = EVERYTHING
    if footprints is None or (footprints["extent"] == EVERYTHING).any():
        return bound
    bounded = footprints[footprints["extent"] == SOMETHING]
    if not len(bounded):
        bound.extent = NOTHING
    elif atlas.layout == PARALLEL:
        _bound_by_cylinder(bound, bounded)
    else:
        _bound_by_cone(bound, bounded)
    return bound


def _bound_by_cylinder(bound: ShadowBound, footprints: npt.NDArray[np.void]) -> None:
    """Sets the bound to a cylinder along a directional light that encloses the casters' footprints (rectangles)."""
    first, second, low, high = (footprints[name].astype(np.float64) for name in ("first", "second", "low", "high"))
    middles = 0.5 * ((low + high)[:, :1] * first + (low + high)[:, 1:] * second)
    center = 0.5 * (middles.min(axis=0) + middles.max(axis=0))
    reach = np.linalg.norm(middles - center, axis=1) + 0.5 * np.linalg.norm(high - low, axis=1)
    bound.extent, bound.axis = SOMETHING, wp.vec3(*center)
    bound.radius = float(reach.max()) * (1.0 + SHADOW_BOUND_MARGIN)


def _bound_by_cone(bound: ShadowBound, footprints: npt.NDArray[np.void]) -> None:
    """Sets the bound to a cone from a point light that encloses the casters' footprints (cones).

    The bound is unchanged if casters lie on all sides of the light.
    """
    directions = footprints["direction"].astype(np.float64)
    axis = directions.mean(axis=0)
    if np.linalg.norm(axis) <= SHADOW_BOUND_MARGIN:
        return
    axis /= np.linalg.norm(axis)
    from_axis = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(directions - axis, axis=1), 1.0))
    angles = np.arctan2(footprints["sine"], footprints["cosine"])
    bound.extent, bound.axis = SOMETHING, wp.vec3(*axis)
    bound.radius = float((from_axis + angles).max()) + SHADOW_BOUND_MARGIN


def face_count(atlas: Atlas) -> int:
    """Returns the number of square faces (images of texels) of a light's atlas."""
    return 6 if atlas.layout == CUBEMAP else 1


def _fit_sphere(
    atlas: Atlas, source: npt.NDArray[np.float64], around: PlacedGaussians, config: DeepShadowConfig
) -> None:
    atlas.origin = wp.vec3(*source)
    atlas.layout, atlas.size = OCTAHEDRAL, config.resolution
    if config.layout is AtlasLayout.CUBEMAP:
        tiles = round(config.resolution / math.sqrt(6.0) / SHADOW_TILE)
        atlas.layout, atlas.size = CUBEMAP, max(tiles, 1) * SHADOW_TILE
    distances = np.linalg.norm(around.means - source, axis=1) + _reach(around)
    atlas.bin_length = (config.max_distance or float(distances.max(initial=0.0)) or 1.0) / config.bins


def _fit_plane(atlas: Atlas, source: LightDirectional, around: PlacedGaussians, config: DeepShadowConfig) -> None:
    """Places the texel plane of a directional light in front of the Gaussians, just large enough to cover them."""
    forward = np.array(source.direction)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    local, reach = around.means @ axes, _reach(around)[:, None]
    low = (local - reach).min(axis=0, initial=math.inf) if len(around.means) else np.zeros(3)
    high = (local + reach).max(axis=0, initial=-math.inf) if len(around.means) else np.ones(3)
    # Receivers in one plane or at one point have no extent to divide by.
    length = max(*(high - low), 1e-3)
    # Lookups read half a texel beyond the edges, so there is one more texel on each side.
    texel = max(high[0] - low[0], high[1] - low[1], 1e-3 * length) / (config.resolution - 2)
    atlas.layout, atlas.size = PARALLEL, config.resolution
    atlas.axes = wp.mat33(*axes.ravel())
    atlas.texel_length = texel
    # One extra bin in front: casters may be in front of the centre of the first bin, up to which nothing is shadowed.
    depth = config.max_distance or max(float(high[2] - low[2]), texel)
    atlas.bin_length = depth / max(config.bins - 1, 1)
    atlas.origin = wp.vec3(*(axes @ (low - [texel, texel, atlas.bin_length])))


def _reach(around: PlacedGaussians) -> npt.NDArray[np.floating]:
    """Returns the footprint radius of N Gaussians, shape (N,): 3 times the largest standard deviation of each."""
    return SHADOW_FOOTPRINT * around.scales.max(axis=1, initial=0.0)


@dataclass(frozen=True, slots=True)
class Region:
    """The texels and depth bins for which a deep shadow map tabulates transmittance; it assumes 1 in all other bins.

    A column is the range of depth bins of one texel.
    """

    texels: IntArray
    """Index of each texel that has a column (range of depth bins), ascending."""
    first: IntArray
    """Index of the first tabulated depth bin of each texel in ``texels``."""
    count: IntArray
    """Number of tabulated depth bins of each texel in ``texels``."""

    @property
    def voxel_count(self) -> int:
        """Number of tabulated depth bins over all texels."""
        return int(self.count.sum(dtype=np.int64))

    @property
    def tiles(self) -> IntArray:
        """Indices of the tiles (squares of texels) that contain tabulated texels, ascending."""
        return np.unique(self.texels // TILE_TEXELS)

    def columns(self, atlas: Atlas) -> tuple[IntArray, npt.NDArray[np.void]]:
        """Returns the table's layout: the slot of each tile of the atlas, and a Column row per texel of each slot.

        A tile without tabulated texels has slot -1; rows of texels that are not tabulated are 0.

        Raises:
            SceneError: The region has 2^31 bins or more.
        """
        if self.voxel_count >= 2**31:
            raise SceneError(
                f"a deep shadow map of {self.voxel_count:,} bins is too large: pass receivers, "
                "or lower DeepShadowConfig.resolution"
            )
        tiles = self.tiles
        slots = np.full(texel_count(atlas) // TILE_TEXELS, -1, np.int32)
        slots[tiles] = np.arange(len(tiles))
        rows = np.zeros(len(tiles) * TILE_TEXELS, dtype=table_dtype(Column))
        rows_of_texels = slots[self.texels // TILE_TEXELS] * TILE_TEXELS + self.texels % TILE_TEXELS
        rows["first"][rows_of_texels], rows["count"][rows_of_texels] = self.first, self.count
        rows["offset"][rows_of_texels] = np.cumsum(self.count) - self.count
        return slots, rows


def texel_count(atlas: Atlas) -> int:
    """Returns the number of texels of an atlas, over all its faces."""
    return face_count(atlas) * atlas.size**2


def whole_region(atlas: Atlas) -> Region:
    """Returns the region in which every texel and depth bin of the atlas is tabulated."""
    count = texel_count(atlas)
    return Region(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), np.full(count, atlas.bins, np.int32))


def all_tiles(atlas: Atlas) -> IntArray:
    """Returns the indices of all tiles (squares of texels) of an atlas."""
    return np.arange(texel_count(atlas) // TILE_TEXELS, dtype=np.int32)


def region_of_casters(
    atlas: Atlas,
    casters: PlacedGaussians,
    tiles: IntArray,
    *,
    items: IntArray,
    counts: IntArray,
    deviations: float,
) -> Region:
    """Returns the region that casters can shadow: texels of tiles, bins from a tile's nearest to its farthest caster.

    Args:
        atlas: The light's atlas.
        casters: C Gaussians.
        tiles: Indices of T tiles, ascending.
        items: Indices of the casters that may shadow each tile, tile by tile.
        counts: Number of casters of each tile, shape (T,).
        deviations: Distance from its mean, in its largest standard deviations, to which a caster reaches.
    """
    offsets = casters.means - np.array(atlas.origin)
    if atlas.layout == PARALLEL:
        distances = offsets @ np.array(atlas.axes).reshape(3, 3)[:, 2]
    else:
        distances = np.linalg.norm(offsets, axis=1)
    reach = deviations * casters.scales.max(axis=1)
    ends = [np.clip(t / atlas.bin_length - 0.5, -1.0, atlas.bins) for t in (distances - reach, distances + reach)]
    filled, starts = counts > 0, np.cumsum(counts, dtype=np.int64) - counts
    texels = (tiles[filled, None] * TILE_TEXELS + np.arange(TILE_TEXELS)).ravel().astype(np.int32)
    if not len(texels):
        return Region(texels, texels, texels)
    nearest = np.asarray(np.minimum.reduceat(ends[0].astype(np.int32)[items], starts[filled]), np.int32)
    farthest = np.asarray(np.maximum.reduceat(ends[1].astype(np.int32)[items], starts[filled]), np.int32)
    first = np.repeat(np.clip(nearest, 0, atlas.bins - 1), TILE_TEXELS)
    last = np.repeat(np.clip(farthest + 1, 0, atlas.bins - 1), TILE_TEXELS)
    return Region(texels, first, last - first + 1)


def region_of_receivers(
    launcher: Launcher, atlas: Atlas, receivers: Receivers, rows: IntArray, sampling: FootprintSampling
) -> Region:
    """Returns the texels and depth bins that are read when shadows of the receivers number ``rows`` are looked up."""
    buffers = Buffers(launcher.device)  # temporary arrays over all texels
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
