"""Host pass: rays through Gaussians and meshes, into the surface buffers (Moenne-Loccoz et al. 2024)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lumisplat.config import HitDistance, NormalMethod, RenderConfig, ShadowConfig, TraceConfig, TraceStrategy
from lumisplat.constants import HITS_HELD_CPU, PACKET_RAYS, RAY_BANDS_PER_THREAD, RAY_BLOCK_PX
from lumisplat.device.structs.bvh import TraceData
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.renderer.scene import gaussian_bvh_kernels
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.device_scene import DeviceScene, table_dtype
from lumisplat.renderer.shadow.shadow_rays import ShadowRays, shadow_modules
from lumisplat.renderer.trace import camera_ray_kernels, gaussian_trace_kernels, mesh_trace_kernels
from lumisplat.renderer.trace.mesh_trace import MeshTracer
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera

_STRATEGIES = {
    TraceStrategy.SORTED: gaussian_trace_kernels.SORTED,
    TraceStrategy.STOCHASTIC_HIT: gaussian_trace_kernels.HIT,
    TraceStrategy.STOCHASTIC_PASS: gaussian_trace_kernels.PASS,
}


class RayTracer:
    """Follows rays through Gaussians and from mesh to mesh.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings; they do not change.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._lanes = 1 if launcher.is_parallel else PACKET_RAYS
        self._integrate = trace_kernel_of(launcher, config)
        self.mesh_hits = MeshTracer(launcher, buffers)
        """Looks for meshes alone."""
        self._settings = buffers.get("trace.settings", TraceData, 1)
        self._settings.assign(trace_table(config.trace))
        self._transmit = ShadowRays(launcher, buffers, replace(config, shadow=ShadowConfig()), "transmit")

    def look(self, scene: DeviceScene, trees: BvhScene, rays: RayData) -> PrimaryHits:
        """What rays meet.

        Args:
            scene: After ``sync`` and ``sync_rays``.
            trees: Of the same scene.
            rays: A multiple of ``PACKET_RAYS``; ``t_max`` moves to the meshes.
        """
        with self._launcher.stage("mesh"):
            hits = self.mesh_hits.find(scene, rays, "trace.hits")
        with self._launcher.stage("gaussians"):
            radiance = self.integrate(trees, rays, "trace.radiance")
        return PrimaryHits(rays, hits, radiance)

    def transmit(self, scene: DeviceScene, trees: BvhScene, rays: RayData) -> Any:
        """What of the light from ``t_max`` arrives at the origins of rays, an array of wp.vec3; behind meshes nothing.

        Args:
            scene: After ``sync`` and ``sync_rays``.
            trees: Of the same scene.
            rays: As for ``look``, but that ``t_max`` stays.
        """
        return self._transmit.trace(scene, trees, rays, None, "trace.transmittance", opaque=True)

    def integrate(self, trees: BvhScene, rays: RayData, name: str) -> GaussianHits:
        """What the Gaussians up to ``t_max`` give rays, in buffers of that name."""
        count = rays.t_max.shape[0]
        radiance = self._buffers.struct(name, GaussianHits, count)
        self._launcher.run_banded(
            self._integrate,
            count // self._lanes,
            *(self._settings, trees.instances, trees.assets, trees.tlas_nodes, trees.packet_radius),
            *(rays, radiance),
            bands=RAY_BANDS_PER_THREAD * self._launcher.threads,
        )
        return radiance


def trace_kernel_of(launcher: Launcher, config: RenderConfig) -> Any:
    """The kernel that follows rays on a device, for these settings."""
    hits = config.trace.hits_per_pass
    if launcher.is_parallel:
        return gaussian_trace_kernels.gaussian_trace_kernel(1, hits)
    return gaussian_trace_kernels.gaussian_trace_kernel(PACKET_RAYS, max(hits, HITS_HELD_CPU))


def trace_modules(launcher: Launcher, config: RenderConfig) -> list[Any]:
    """The kernel modules that tracing needs."""
    return [
        gaussian_bvh_kernels,
        mesh_trace_kernels,
        camera_ray_kernels,
        trace_kernel_of(launcher, config).module,
    ]


def transmit_modules(launcher: Launcher) -> list[Any]:
    """The kernel modules that transmittance alone needs besides."""
    return shadow_modules(launcher, RenderConfig())


def ray_count(camera: Camera) -> int:
    """Rays of an image: whole blocks."""
    return PACKET_RAYS * (-(-camera.width // RAY_BLOCK_PX)) * (-(-camera.height // RAY_BLOCK_PX))


def trace_table(config: TraceConfig) -> np.ndarray:
    """The 1-element table that kernels read the tracer's settings from."""
    row = table = np.zeros(1, dtype=table_dtype(TraceData))
    is_sorted = config.strategy is TraceStrategy.SORTED
    row["strategy"] = _STRATEGIES[config.strategy]
    row["hits_per_pass"] = config.hits_per_pass
    row["hull"] = config.hit_distance is HitDistance.HULL
    row["ellipsoid_normal"] = config.normal_method is NormalMethod.ELLIPSOID
    # What ends a sorted ray early would bias a stochastic one, which ends when its lottery is won: at 0.
    row["transmittance_min"] = config.transmittance_min if is_sorted else 0.0
    # A stochastic hit is a surface, whatever the threshold.
    is_hit = config.strategy is TraceStrategy.STOCHASTIC_HIT
    row["depth_iso_transmittance"] = 0.5 if is_hit else config.depth_iso_transmittance
    row["acceptance_scale"] = config.acceptance_scale
    return table
