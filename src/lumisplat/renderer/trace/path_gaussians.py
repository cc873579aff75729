"""Host pass: what Gaussians give rays of paths (docs/method/paths.md#surfaces)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import warp as wp

from lumisplat.config import PathPrimary, RenderConfig, TraceStrategy
from lumisplat.constants import EMITTER_OPAQUE
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits, RayData
from lumisplat.renderer.scene.bvh_scene import SplatSets
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace import path_gaussians_kernels as kernels
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class DarkenedCaptures(NamedTuple):
    """Captures that rays see as black, since surfaces receive their light as that of lights."""

    marked: DeviceArray
    """The scene's splat instances, with these marked as relit."""
    mirrored: wp.array[int] | None
    """1: a mirror has reflected the ray, which sees them as they are; None: none has."""


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
        self._stochastic = GaussianTracer(
            launcher, buffers, _with(config, TraceStrategy.STOCHASTIC_HIT), "trace.stochastic"
        )
        ended = _with(config, TraceStrategy.SORTED)
        ended = replace(ended, trace=replace(ended.trace, transmittance_min=EMITTER_OPAQUE))
        self._emitted = GaussianTracer(launcher, buffers, ended, "trace.emitted")

    def modules(self, plan: FramePlan, *, bounced: bool) -> list[KernelModule]:
        """The kernel modules of a frame; of rays that surfaces have scattered, too, if they are ``bounced``."""
        if not plan.traces_paths:
            return self._blended.modules(bounced=bounced)
        modules = self._blended.modules(bounced=bounced)
        if plan.relights or not plan.has_emissive_captures:
            modules += self._stochastic.modules(bounced=True)
        return [*modules, kernels] if plan.has_emissive_captures else modules

    def find(
        self,
        scene: DeviceScene,
        rays: RayData,
        limits: wp.array[float],
        name: str,
        *,
        bounced: bool,
        dark: DarkenedCaptures | None = None,
    ) -> GaussianHits:
        """As `GaussianTracer.find`: a ray that meets a relit Gaussian has a transmittance of 0.

        Args:
            scene: Up to date for rays.
            rays: A multiple of ``PACKET_RAYS``.
            limits: Distances as float, such as those of the nearest meshes.
            name: Of the buffers that hold the result.
            bounced: Whether the rays were scattered by surfaces, which they leave as shadow rays do.
            dark: Captures that the rays see as black; None: there are none.
        """
        if not scene.plan.traces_paths or (self._is_blended_first and not bounced):
            return self._blended.find(scene, rays, limits, name, bounced=bounced)
        if not scene.plan.has_emissive_captures:
            return self._stochastic.find(scene, rays, limits, name, bounced=bounced, sets=SplatSets.RELIT)
        if not scene.plan.relights:
            return self._find_captured(scene, rays, limits, name, bounced=bounced, dark=dark)
        relit, ends = self._find_relit(scene, rays, limits, name, bounced=bounced)
        captured = self._find_captured(scene, rays, ends, name, bounced=bounced, dark=dark)
        self._launcher.run_banded(kernels.choose_hits, len(rays.t_max), rays, relit, captured)
        return captured

    def find_emitted(
        self, scene: DeviceScene, rays: RayData, limits: wp.array[float], marked: DeviceArray, name: str
    ) -> GaussianHits:
        """What captures that are kept give bounced rays up to what these meet, and apart that of the marked ones.

        Rays end where `EMITTER_OPAQUE` of them is left.

        Args:
            scene: Up to date for rays.
            rays: A multiple of ``PACKET_RAYS``.
            limits: Distances as float, such as those of the nearest meshes.
            marked: The splat instances, as for `GaussianTracer.find`.
            name: Of the buffers that hold the result.
        """
        if scene.plan.relights:
            limits = self._find_relit(scene, rays, limits, name, bounced=True)[1]
        return self._emitted.find(scene, rays, limits, name, bounced=True, sets=SplatSets.CAPTURED, marked=marked)

    def _find_relit(
        self, scene: DeviceScene, rays: RayData, limits: wp.array[float], name: str, *, bounced: bool
    ) -> tuple[GaussianHits, DeviceArray]:
        """The relit Gaussian that each ray meets, and where the ray ends, by that or at its limit."""
        relit = self._stochastic.find(scene, rays, limits, f"{name}.relit", bounced=bounced, sets=SplatSets.RELIT)
        ends = self._buffers.get(f"{name}.ends", wp.float32, len(rays.t_max))
        self._launcher.run_banded(kernels.end_at_surfaces, len(rays.t_max), limits, relit, ends)
        return relit, ends

    def _find_captured(
        self,
        scene: DeviceScene,
        rays: RayData,
        limits: wp.array[float],
        name: str,
        *,
        bounced: bool,
        dark: DarkenedCaptures | None,
    ) -> GaussianHits:
        """What captures that are kept give rays."""
        marked = dark.marked if dark else None
        hits = self._blended.find(scene, rays, limits, name, bounced=bounced, sets=SplatSets.CAPTURED, marked=marked)
        if dark is None:
            return hits
        self._launcher.run_banded(kernels.darken, len(rays.t_max), rays, dark.mirrored, hits)
        return self._buffers.struct(name, GaussianHits, len(rays.t_max), EXTRA_FIELDS)

    def find_captured(self, scene: DeviceScene, rays: RayData, ends: wp.array[float], name: str) -> GaussianHits:
        """What shadow-only sets alone give bounced rays, as `RayTracer.find_captured`."""
        return self._blended.find(scene, rays, ends, name, bounced=True, sets=SplatSets.SHADOW_CATCHERS)


def _with(config: RenderConfig, strategy: TraceStrategy) -> RenderConfig:
    return replace(config, trace=replace(config.trace, strategy=strategy))
