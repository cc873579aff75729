"""Host pass: what Gaussians give rays of paths (docs/method/paths.md#surfaces)."""

from __future__ import annotations

from dataclasses import replace

import warp as wp

from lumisplat.config import PathPrimary, RenderConfig, TraceStrategy
from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.renderer.scene.bvh_scene import SplatSets
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import path_gaussians_kernels as kernels
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


class PathGaussians:
    """Follows rays of paths through Gaussians: relit ones are met one at a time, captures that are kept are blended.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings; they do not change.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._is_blended_first = config.path.primary is PathPrimary.ISO
        self._blended = GaussianTracer(launcher, buffers, _with(config, TraceStrategy.SORTED), "trace.blended")
        self._met = GaussianTracer(launcher, buffers, _with(config, TraceStrategy.STOCHASTIC_HIT), "trace.met")

    def find(
        self, scene: DeviceScene, rays: RayData, limits: wp.array[float], name: str, *, bounced: bool
    ) -> GaussianHits:
        """As `GaussianTracer.find`: a ray that meets a relit Gaussian has a transmittance of 0."""
        if not scene.traces_paths or (self._is_blended_first and not bounced):
            return self._blended.find(scene, rays, limits, name, bounced=bounced)
        if not scene.keeps_captures:
            return self._met.find(scene, rays, limits, name, bounced=bounced, sets=SplatSets.RELIT)
        if not scene.relights:
            return self._blended.find(scene, rays, limits, name, bounced=bounced, sets=SplatSets.KEPT)
        count, run = len(rays.t_max), self._launcher.run_banded
        met = self._met.find(scene, rays, limits, f"{name}.met", bounced=bounced, sets=SplatSets.RELIT)
        ends = self._buffers.get(f"{name}.ends", wp.float32, count)
        run(kernels.end_at_surfaces, count, limits, met, ends)
        kept = self._blended.find(scene, rays, ends, name, bounced=bounced, sets=SplatSets.KEPT)
        run(kernels.choose_hits, count, rays, met, kept)
        return kept

    def find_captured(self, scene: DeviceScene, rays: RayData, ends: wp.array[float], name: str) -> GaussianHits:
        """What shadow-only sets alone give bounced rays, as `RayTracer.find_captured`."""
        return self._blended.find(scene, rays, ends, name, bounced=True, sets=SplatSets.SHADOW_ONLY)


def _with(config: RenderConfig, strategy: TraceStrategy) -> RenderConfig:
    return replace(config, trace=replace(config.trace, strategy=strategy))
