"""Extents of lights that cast penumbrae by a deep shadow map.

Source: docs/method/deep_shadow_maps.md#lights-with-an-extent.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import warp as wp

from lumisplat.device.shadow_map.atlas import EVERYTHING, PARALLEL, SOMETHING, Atlas
from lumisplat.device.shadow_map.light_extent import DISK, POINT, RECT, ROUND, LightExtent
from lumisplat.device.shadow_map.lookup import ShadowBound
from lumisplat.scene.lights import FlatLight, LightDirectional, LightRect, RoundLight
from lumisplat.shadow_maps.atlas import Region

SHADOW_ANGLE_MAX = math.pi / 4.0
"""Largest angular radius of parallel light, radians: the tangents of wider ones leave the map."""


def extent_of(light: object) -> LightExtent:
    """Returns the extent of a light; a point, or a light without size, has none."""
    extent = LightExtent()
    if isinstance(light, LightRect):
        extent.shape, extent.first, extent.second = RECT, wp.vec3(*light.edge_u), wp.vec3(*light.edge_v)
        diagonals = np.add(light.edge_u, light.edge_v), np.subtract(light.edge_u, light.edge_v)
        extent.radius = 0.5 * max(float(np.linalg.norm(diagonal)) for diagonal in diagonals)
    elif isinstance(light, LightDirectional) and light.angle > 0.0:
        extent.shape, extent.first = DISK, wp.vec3(*light.direction)
        extent.radius = math.tan(min(light.angle, SHADOW_ANGLE_MAX))
    elif isinstance(light, RoundLight) and light.radius > 0.0:
        extent.shape, extent.radius = ROUND, light.radius
        if isinstance(light, FlatLight):
            extent.shape, extent.first = DISK, wp.vec3(*light.direction)
    return extent


def has_extent(extent: LightExtent) -> bool:
    """Returns whether a light has an extent, so that its map holds optical depths and its shadows have penumbrae."""
    return extent.shape != POINT


def bound_depths(extent: LightExtent, atlas: Atlas, region: Region) -> None:
    """Sets the distances between which the tabulated casters of a light are.

    Casters inside a sphere block nothing, nor do those nearer to a flat light's centre than a tenth of its radius.
    """
    extent.near, extent.far = 0.0, 0.0
    if len(region.texels):
        extent.near = (float(region.first.min()) - 0.5) * atlas.bin_length
        extent.far = (float((region.first + region.count).max()) - 0.5) * atlas.bin_length
    if atlas.layout != PARALLEL:
        extent.near = max(extent.near, extent.radius if extent.shape == ROUND else 0.1 * extent.radius)
        extent.far = max(extent.far, extent.near)


def widen_bound(bound: ShadowBound, atlas: Atlas, extent: LightExtent) -> None:
    """Widens the bound of all points that casters can shadow by the penumbra of a light with an extent."""
    if bound.extent != SOMETHING:
        return
    if atlas.layout == PARALLEL:
        bound.spread = extent.radius
    elif extent.radius >= extent.near:
        bound.extent = EVERYTHING
    else:
        bound.radius += math.asin(extent.radius / extent.near)


def extent_record(extent: LightExtent) -> dict[str, Any]:
    """Returns the shape of an extent as JSON values."""
    first, second = ([float(x) for x in edge] for edge in (extent.first, extent.second))
    return {"shape": int(extent.shape), "radius": float(extent.radius), "first": first, "second": second}


def extent_from_record(record: dict[str, Any]) -> LightExtent:
    """Returns the extent that `extent_record` describes.

    Raises:
        ValueError: The record describes no extent.
    """
    extent = LightExtent()
    extent.shape, extent.radius = int(record["shape"]), float(record["radius"])
    extent.first, extent.second = wp.vec3(*record["first"]), wp.vec3(*record["second"])
    sizes = np.array([extent.radius, *extent.first, *extent.second])
    if extent.shape not in (POINT, ROUND, DISK, RECT) or not np.isfinite(sizes).all() or extent.radius < 0.0:
        raise ValueError("no extent")
    return extent
