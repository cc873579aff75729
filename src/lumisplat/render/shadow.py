"""Host pass: what of a light reaches the points that it may shine on."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.buffers import Buffers
from lumisplat.config import HitDistance, RenderConfig, ShadowMethod
from lumisplat.constants import PACKET_RAYS, RAY_BANDS_PER_THREAD, TILE_BANDS_PER_THREAD
from lumisplat.device.ray_structs import RayData
from lumisplat.device.trace_structs import ShadowData
from lumisplat.launcher import Launcher
from lumisplat.render import shadow_kernels as kernels
from lumisplat.render.device_scene import DeviceScene, table_dtype
from lumisplat.render.tree_scene import TreeScene

_METHODS = {ShadowMethod.EXACT: kernels.EXACT, ShadowMethod.STOCHASTIC: kernels.STOCHASTIC}


class ShadowRays:
    """Looks from points to lights.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings; they do not change.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._lanes = 1 if launcher.is_parallel else PACKET_RAYS
        self._settings = buffers.get("shadow.settings", ShadowData, 1)
        self._settings.assign(shadow_table(config))

    def trace(
        self, scene: DeviceScene, trees: TreeScene, rays: RayData, skips: wp.array[wp.int32], name: str
    ) -> wp.array[wp.vec3]:
        """What of the light from ``t_max`` arrives at each ray's origin, per channel, 0..1.

        Args:
            scene: After ``sync`` and ``sync_rays``.
            trees: Of the same scene.
            rays: From the point to the light, a multiple of ``PACKET_RAYS``. Meshes count from the origin on, Gaussians
                from ``t_min``; ``t_max`` is the light's distance, inf for one infinitely far. Where it is not above 0,
                there is no ray, and the result any number.
            skips: 1: the ray does not see Gaussians of instances that are ``shadow_only``.
            name: Of the buffer that holds the result.
        """
        count = rays.t_max.shape[0]
        light = self._buffers.get(name, wp.vec3, count)
        limits = self._buffers.get("shadow.limits", wp.float32, count)
        self._launcher.run_banded(
            kernels.shade_by_meshes,
            count,
            *(scene.placements, scene.mesh_instances, scene.mesh_data, rays, light, limits),
            bands=TILE_BANDS_PER_THREAD * self._launcher.threads,
        )
        self._launcher.run_banded(
            occluder_of(self._launcher),
            count // self._lanes,
            *(self._settings, trees.instances, trees.assets, trees.top_nodes, trees.bundle_radius),
            *(rays, limits, skips, light),
            bands=RAY_BANDS_PER_THREAD * self._launcher.threads,
        )
        return light


def shadow_modules(launcher: Launcher) -> list[Any]:
    """The kernel modules that shadow rays need."""
    return [kernels, occluder_of(launcher).module]


def occluder_of(launcher: Launcher) -> Any:
    """The kernel that takes shadow rays through Gaussians on a device."""
    return kernels.occluder(1 if launcher.is_parallel else PACKET_RAYS)


def shadow_table(config: RenderConfig) -> np.ndarray:
    """The 1-element table that kernels read the settings of shadow rays from."""
    row = table = np.zeros(1, dtype=table_dtype(ShadowData))
    row["method"] = _METHODS[config.shadow.method]
    row["hull"] = config.trace.hit_distance is HitDistance.HULL
    row["transmittance_min"] = config.trace.transmittance_min
    row["threshold"] = config.shadow.transmittance_threshold
    row["color_strength"] = config.shadow.color_strength
    return table
