"""Receivers in the forms that users give them, as Gaussians in the world, and where they sample a deep shadow map."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import DeepShadowConfig, ReceiverSampling
from lumisplat.device.structs.shadow_map import CENTER, RANDOM, STENCIL, FootprintSampling, Receivers
from lumisplat.errors import check_shapes
from lumisplat.math.arrays import Doubles, float_array
from lumisplat.runtime.buffers import Buffers
from lumisplat.scene.ops.world_space import PlacedGaussians
from lumisplat.shadow_maps.casters import Content, MeshesAsGaussians, as_iterable

Receiving = Content | Iterable[Content] | npt.ArrayLike
"""What a map is sampled for: Gaussians, or what can be turned into them, or points."""

_PATTERN = {
    ReceiverSampling.CENTER: CENTER,
    ReceiverSampling.STENCIL: STENCIL,
    ReceiverSampling.MONTE_CARLO: RANDOM,
}
_STENCIL_POINTS = 7


def placed_receivers(receivers: Receiving, origin: Doubles) -> PlacedGaussians:
    """Receivers in the world about an origin, shape (3,), those that are points as Gaussians without extent.

    Raises:
        SceneError: Something is of another kind, or a value is not finite.
    """
    if isinstance(receivers, Content):
        return MeshesAsGaussians().placed("receivers", receivers, origin)
    if isinstance(receivers, np.ndarray):
        return placed_points(cast("npt.ArrayLike", receivers), origin)
    items: list[Any] = list(as_iterable("receivers", receivers))
    if items and isinstance(items[0], Content):
        return MeshesAsGaussians().placed("receivers", items, origin)
    return placed_points(items, origin)


def placed_points(values: npt.ArrayLike, origin: Doubles) -> PlacedGaussians:
    """Points, shape (N, 3), as Gaussians without extent, about an origin.

    Raises:
        SceneError: The shape does not fit, or values are not finite.
    """
    points = float_array("points", values)
    if points.size == 0:
        points = points.reshape(0, 3)
    check_shapes(points=(points, "N 3"))
    if origin.any():
        points = (np.asarray(values, np.float64).reshape(-1, 3) - origin).astype(np.float32)
    unturned = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(points), 1))
    return PlacedGaussians(points, unturned, np.zeros_like(points), np.zeros(len(points), np.float32))


def upload_receivers(buffers: Buffers, placed: PlacedGaussians) -> Receivers:
    """Copies receivers to the device."""
    receivers = Receivers()
    receivers.means = buffers.upload("receivers.means", wp.vec3, placed.means)
    receivers.rotations = buffers.upload("receivers.rotations", wp.quat, placed.rotations_xyzw)
    receivers.scales = buffers.upload("receivers.scales", wp.vec3, placed.scales)
    return receivers


def footprint_sampling(config: DeepShadowConfig, receivers: PlacedGaussians) -> FootprintSampling:
    """The samples of each receiver as the settings say; of receivers without extent, their means."""
    sampling = FootprintSampling()
    sampling.pattern, sampling.count = _PATTERN[config.sampling], config.samples
    sampling.seed = wp.uint32(config.seed)
    if config.sampling is ReceiverSampling.STENCIL:
        sampling.count = _STENCIL_POINTS
    if config.sampling is ReceiverSampling.CENTER or not receivers.scales.any():
        sampling.pattern, sampling.count = CENTER, 1
    return sampling
