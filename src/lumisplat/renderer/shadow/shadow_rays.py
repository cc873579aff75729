"""Host pass: what of a light reaches the points that it may shine on."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import HitDistance, RenderConfig, ShadowMethod
from lumisplat.constants import PACKET_RAYS, RAY_BANDS_PER_THREAD, TILE_BANDS_PER_THREAD
from lumisplat.device.structs.bvh import ShadowData
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.device_scene import DeviceScene, table_dtype
from lumisplat.renderer.shadow import gaussian_shadow_kernels, mesh_shadow_kernels, stochastic_bvh_kernels
from lumisplat.renderer.shadow.stochastic_bvh import StochasticBvh
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


class ShadowRays:
    """Looks from points to lights.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings; they do not change.
        name: Of the buffers.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, name: str = "shadow") -> None:
        self._launcher, self._buffers, self._name = launcher, buffers, name
        self._lanes = 1 if launcher.is_parallel else PACKET_RAYS
        self._shade = shadow_kernel_of(launcher, config)
        self._is_stochastic = config.shadow.method is ShadowMethod.STOCHASTIC
        self._shrunk = StochasticBvh(launcher, buffers, name)
        self._table = shadow_table(config)
        self._settings = buffers.get(f"{name}.settings", ShadowData, 1)
        self._settings.assign(self._table)

    def begin_sample(self, sample: int) -> None:
        """Before the rays of a sample: stochastic shadows are drawn anew for each."""
        if self._is_stochastic:
            self._table["sample"] = sample
            self._settings.assign(self._table)
            self._shrunk.forget()

    def trace(
        self, scene: DeviceScene, trees: BvhScene, rays: RayData, skips: Any, name: str, *, opaque: bool = False
    ) -> Any:
        """What of the light from ``t_max`` arrives at each ray's origin: linear, per channel, 0..1, as wp.vec3.

        Args:
            scene: After ``sync`` and ``sync_rays``.
            trees: Of the same scene.
            rays: From the point to the light, a multiple of ``PACKET_RAYS``. Meshes count from the origin on, Gaussians
                from ``t_min``; ``t_max`` is the light's distance, inf for one infinitely far. Where it is not above 0,
                there is no ray, and the result is any number.
            skips: Array of int. 1: the ray does not see Gaussians of instances that are ``shadow_only``. None: all do.
            name: Of the buffer that holds the result.
            opaque: All meshes are, also those of glass.
        """
        count, run = rays.t_max.shape[0], self._launcher.run_banded
        light = self._buffers.get(name, wp.vec3, count)
        limits = self._past_meshes(scene, rays, light, opaque)
        if skips is None:
            skips = self._buffers.get(f"{self._name}.skips", wp.int32, count)
            skips.zero_()
        assets = trees.assets
        if self._is_stochastic:
            assets = self._shrunk.assets(scene, trees, self._settings, ray_count=count)
        run(
            self._shade,
            count // self._lanes,
            *(self._settings, trees.instances, assets, trees.tlas_nodes, trees.packet_radius),
            *(rays, limits, skips, light),
            bands=RAY_BANDS_PER_THREAD * self._launcher.threads,
        )
        return light

    def _past_meshes(self, scene: DeviceScene, rays: RayData, light: Any, opaque: bool) -> Any:
        """Writes what meshes let through; how far Gaussians have to be looked for."""
        if scene.placements.shape[0] == 0:
            light.fill_(1.0)
            return rays.t_max
        count = rays.t_max.shape[0]
        limits = self._buffers.get(f"{self._name}.limits", wp.float32, count)
        self._launcher.run_banded(
            mesh_shadow_kernels.shade_by_meshes,
            count,
            *(int(opaque), scene.placements, scene.mesh_instances, scene.mesh_data, rays, light, limits),
            bands=TILE_BANDS_PER_THREAD * self._launcher.threads,
        )
        return limits


def shadow_modules(launcher: Launcher, config: RenderConfig) -> list[Any]:
    """The kernel modules that shadow rays need."""
    return [mesh_shadow_kernels, stochastic_bvh_kernels, shadow_kernel_of(launcher, config).module]


def shadow_kernel_of(launcher: Launcher, config: RenderConfig) -> Any:
    """The kernel that takes shadow rays through Gaussians on a device."""
    hits = config.shadow.hits if config.shadow.method is ShadowMethod.FIRST_HITS else 0
    return gaussian_shadow_kernels.shadow_kernel(1 if launcher.is_parallel else PACKET_RAYS, hits)


def shadow_table(config: RenderConfig) -> np.ndarray:
    """The 1-element table that kernels read the settings of shadow rays from."""
    row = table = np.zeros(1, dtype=table_dtype(ShadowData))
    row["stochastic"] = config.shadow.method is ShadowMethod.STOCHASTIC
    is_first = config.shadow.method is ShadowMethod.FIRST_HITS
    row["hull"] = is_first and config.trace.hit_distance is HitDistance.HULL
    row["transmittance_min"] = config.trace.transmittance_min
    row["threshold"] = config.shadow.transmittance_threshold
    row["color_strength"] = config.shadow.color_strength
    row["seed"] = config.seed
    return table
