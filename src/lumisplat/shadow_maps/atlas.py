"""From a light to the atlas of its deep shadow map."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import AtlasLayout, DeepShadowConfig
from lumisplat.constants import SHADOW_BOUND_MARGIN, SHADOW_FOOTPRINT, SHADOW_TILE
from lumisplat.device.shadow_map.atlas import CUBEMAP, OCTAHEDRAL, PARALLEL, Atlas
from lumisplat.device.shadow_map.optical_depth import EVERYTHING, SOMETHING
from lumisplat.device.structs.shadow_map import Shade
from lumisplat.errors import SceneError
from lumisplat.math.arrays import float_array
from lumisplat.scene.lights import LightDirectional, LightPoint, LightRect, LightSphere, LightSpot
from lumisplat.scene.ops.world_gaussians import PlacedGaussians

Source = npt.NDArray[np.float64] | LightDirectional
"""Where light comes from: a point, or from far away."""


def source_of(light: object) -> Source:
    """Where a light, or a point given in its place, shines from.

    Raises:
        SceneError: It is neither, or not finite.
    """
    if isinstance(light, LightDirectional):
        return light
    if isinstance(light, LightPoint | LightSpot | LightSphere | LightRect):
        return np.array(light.position, dtype=np.float64)
    if not isinstance(light, list | tuple | np.ndarray):
        raise SceneError(f"light_position is a {type(light).__name__}, expected a point (3,), or a light at a place")
    position = float_array("light_position", light)
    if position.shape != (3,):
        raise SceneError(f"light_position has shape {position.shape}, expected three numbers")
    return position.astype(np.float64)


def atlas_of(source: Source, around: PlacedGaussians, config: DeepShadowConfig) -> Atlas:
    """The atlas of a light.

    Args:
        source: Where light comes from.
        around: What the bins reach to, and the plane of parallel light covers: receivers, or for want of them casters.
        config: Settings.
    """
    atlas = Atlas()
    atlas.bins = config.bins
    if isinstance(source, LightDirectional):
        _place_plane(atlas, source, around, config)
    else:
        _place_point(atlas, source, around, config)
    return atlas


def shade_of(atlas: Atlas, footprints: np.ndarray | None) -> Shade:
    """What surrounds the footprints of casters, rows of Footprint; None: everything."""
    shade = Shade()
    shade.axis, shade.radius = wp.vec3(0.0, 0.0, 1.0), math.inf
    if footprints is None or (footprints["extent"] == int(EVERYTHING)).any():
        return shade
    met = footprints[footprints["extent"] == int(SOMETHING)]
    if not len(met):
        shade.radius = -math.inf
    elif atlas.layout == int(PARALLEL):
        first, second = met["first"].astype(np.float64), met["second"].astype(np.float64)
        low, high = met["low"].astype(np.float64), met["high"].astype(np.float64)
        middles = 0.5 * ((low + high)[:, :1] * first + (low + high)[:, 1:] * second)
        center = 0.5 * (middles.min(axis=0) + middles.max(axis=0))
        reach = np.linalg.norm(middles - center, axis=1) + 0.5 * np.linalg.norm(high - low, axis=1)
        shade.axis, shade.radius = wp.vec3(*center), float(reach.max()) * (1.0 + SHADOW_BOUND_MARGIN)
    else:
        directions = met["direction"].astype(np.float64)
        axis = directions.mean(axis=0)
        if np.linalg.norm(axis) > SHADOW_BOUND_MARGIN:
            axis /= np.linalg.norm(axis)
            apart = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(directions - axis, axis=1), 1.0))
            angles = np.arctan2(met["sine"], met["cosine"])
            shade.axis, shade.radius = wp.vec3(*axis), float((apart + angles).max()) + SHADOW_BOUND_MARGIN
    return shade


def face_count(atlas: Atlas) -> int:
    """Squares that the atlas has."""
    return 6 if atlas.layout == int(CUBEMAP) else 1


def _place_point(
    atlas: Atlas, source: npt.NDArray[np.float64], around: PlacedGaussians, config: DeepShadowConfig
) -> None:
    atlas.origin = wp.vec3(*source)
    atlas.layout, atlas.size = int(OCTAHEDRAL), config.resolution
    if config.layout is AtlasLayout.CUBEMAP:
        tiles = round(config.resolution / math.sqrt(6.0) / SHADOW_TILE)
        atlas.layout, atlas.size = int(CUBEMAP), max(tiles, 1) * SHADOW_TILE
    distances = np.linalg.norm(around.means - source, axis=1) + _reach(around)
    atlas.bin_length = (config.max_distance or float(distances.max(initial=0.0)) or 1.0) / config.bins


def _place_plane(atlas: Atlas, source: LightDirectional, around: PlacedGaussians, config: DeepShadowConfig) -> None:
    """Lays a plane across the light, before all that is around, as large as that is."""
    forward = np.array(source.direction)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    local, reach = around.means @ axes, _reach(around)[:, None]
    low = (local - reach).min(axis=0, initial=math.inf) if len(around.means) else np.zeros(3)
    high = (local + reach).max(axis=0, initial=-math.inf) if len(around.means) else np.ones(3)
    # Of receivers in one plane or point, something is left to divide by.
    length = max(*(high - low), 1e-3)
    # Half a texel beyond the edges is read, too: one more on each side.
    texel = max(high[0] - low[0], high[1] - low[1], 1e-3 * length) / (config.resolution - 2)
    atlas.layout, atlas.size = int(PARALLEL), config.resolution
    atlas.axes = wp.mat33(*axes.ravel())
    atlas.texel_length = texel
    # One bin ahead: what is before the first bin's centre counts as lit, but casters may stand there.
    depth = config.max_distance or max(float(high[2] - low[2]), texel)
    atlas.bin_length = depth / max(config.bins - 1, 1)
    atlas.origin = wp.vec3(*(axes @ (low - [texel, texel, atlas.bin_length])))


def _reach(around: PlacedGaussians) -> npt.NDArray[np.floating]:
    """How far from its mean a receiver looks, shape (N,)."""
    return SHADOW_FOOTPRINT * around.scales.max(axis=1, initial=0.0)
