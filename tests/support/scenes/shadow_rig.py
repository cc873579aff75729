"""Traces shadow rays through scenes, as the renderer does between a surface and a light."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig, ShadowConfig
from lumisplat.constants import PACKET_RAYS
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.rays import whole_packets
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene
from support.oracles.random_oracle import sample_keys
from support.scenes.raster_scenes import front_camera

SCHEDULES = ["cpu", "cpu as cuda", "cpu ray by ray", *(device.alias for device in wp.get_cuda_devices())]
"""CPU packets, the CUDA schedule on the CPU, one ray at a time as in path tracing, and every GPU."""


class ShadowRig:
    """Traces rays to lights.

    Args:
        schedule: One of ``SCHEDULES``.
        threads: CPU threads.
    """

    def __init__(self, schedule: str = "cpu", threads: int | None = None) -> None:
        device = schedule.partition(" ")[0]
        self._is_incoherent = schedule.endswith("ray by ray")
        self._launcher = Launcher(device, threads, parallel=True if " as " in schedule else None)
        self._device = device
        self._buffers = Buffers(device)
        self._shadows: dict[RenderConfig, ShadowRays] = {}
        self._scenes: dict[RenderConfig, DeviceScene] = {}
        """Scenes on the device, keyed by the settings that change their bounds."""

    def light(
        self,
        scene: Scene,
        origins: Any,
        directions: Any,
        config: RenderConfig | None = None,
        *,
        t_min: Any = 0.0,
        t_max: Any = np.inf,
        skips: Any = 0,
        normals: Any = 0.0,
        sample: int = 0,
        opaque: bool = False,
        **shadow: Any,
    ) -> np.ndarray:
        """Returns the fraction of light that arrives at the origins, shape (N, 3).

        ``shadow`` are fields of ``ShadowConfig``.
        """
        config = replace(config or RenderConfig(), shadow_rays=ShadowConfig(**shadow))
        # The scene on the device does not depend on shadow settings and the seed.
        bounds = replace(config, shadow_rays=ShadowConfig(), seed=0)
        if bounds not in self._scenes:
            self._scenes[bounds] = DeviceScene(self._launcher, Buffers(self._device), config)
        on_device = self._scenes[bounds]
        on_device.sync(scene, front_camera(), FramePlan.of_rays(config, scene))
        if config not in self._shadows:
            self._shadows[config] = ShadowRays(self._launcher, Buffers(self._device), config)
        shadows = self._shadows[config]
        origins, directions = np.atleast_2d(origins), np.atleast_2d(directions)
        rays, skipping = self._rays(origins, directions, t_min, t_max, skips, normals)
        rays.pixel_key.assign(sample_keys(np.arange(len(rays.pixel_key)), 0, config.seed))
        rays.sample.fill_(sample)
        shadows.begin_sample(sample)
        blocked = wp.full(len(rays.pixel_key), opaque, dtype=wp.bool, device=self._device)
        light = shadows.trace(on_device, rays, skipping, "light", opaque=blocked, incoherent=self._is_incoherent)
        return light.numpy()[: len(origins)].astype(float)

    def _rays(
        self, origins: np.ndarray, directions: np.ndarray, t_min: Any, t_max: Any, skips: Any, normals: Any
    ) -> tuple[RayData, Any]:
        count = max(len(origins), len(directions))
        places = whole_packets(max(count, PACKET_RAYS))
        rays = self._buffers.struct("test.rays", RayData, places)
        skipping = self._buffers.get("test.skips", wp.bool, places)
        rays.origin.assign(_padded(np.broadcast_to(origins, (count, 3)), places))
        rays.direction.assign(_padded(np.broadcast_to(directions, (count, 3)), places))
        rays.t_min.assign(_padded(np.broadcast_to(t_min, count), places))
        rays.t_max.assign(_padded(np.broadcast_to(t_max, count), places))
        rays.is_active.assign(_padded(np.broadcast_to(np.greater(t_max, 0.0), count), places).astype(bool))
        rays.path_length.zero_()
        rays.spread.zero_()
        rays.normal.assign(_padded(np.broadcast_to(normals, (count, 3)), places))
        rays.sample_key.zero_()
        skipping.assign(_padded(np.broadcast_to(skips, count), places).astype(bool))
        return rays, skipping


def _padded(rows: np.ndarray, count: int) -> np.ndarray:
    padded = np.zeros((count, *rows.shape[1:]), np.float32)
    padded[: len(rows)] = rows
    return padded
