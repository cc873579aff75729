"""Traces rays of paths through Gaussians (docs/method/paths.md#surfaces)."""

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
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer, RayLists
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class DarkenedCaptures(NamedTuple):
    """Captures that appear black to secondary rays: surfaces that send the rays sample these captures as lights."""

    marked: DeviceArray
    """Copy of the scene's splat instances whose ``relit`` flag marks the captures to darken."""
    mirrored: wp.array[int] | None
    """1 for each ray that a mirror reflected, else 0. The captures are visible to the rays with 1. None: no ray is
    from a mirror.
    """


class PathGaussians:
    """Traces rays of paths through Gaussians. Relit Gaussians are hit one at a time, emissive captures are blended.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
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

    def tile_modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that trace camera rays through lists of tiles."""
        return self._blended.tile_modules()

    def modules(self, plan: FramePlan, *, bounced: bool) -> list[KernelModule]:
        """Returns the kernel modules of a frame; if ``bounced``, including those for secondary rays."""
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
        from_eye: bool = False,
        dark: DarkenedCaptures | None = None,
        lists: RayLists | None = None,
    ) -> GaussianHits:
        """Returns Gaussian hits like `GaussianTracer.find`; a ray that hits a relit Gaussian has transmittance 0.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            limits: Distances at which rays end, such as those of the nearest meshes.
            name: Name of the buffers that hold the result.
            bounced: Whether the rays start at surfaces. Each ray then skips the Gaussians of its surface, as shadow
                rays do.
            from_eye: Whether all rays start at the eye of the scene's camera.
            dark: Captures that appear black to the rays; None: none.
            lists: As for `GaussianTracer.find`.
        """
        if not scene.plan.traces_paths or (self._is_blended_first and not bounced):
            return self._blended.find(scene, rays, limits, name, bounced=bounced, from_eye=from_eye, lists=lists)
        if not scene.plan.has_emissive_captures:
            return self._stochastic.find(scene, rays, limits, name, bounced=bounced, sets=SplatSets.RELIT, lists=lists)
        if not scene.plan.relights:
            return self._find_captured(scene, rays, limits, name, bounced=bounced, dark=dark, lists=lists)
        relit, ends = self._find_relit(scene, rays, limits, name, bounced=bounced, lists=lists)
        captured = self._find_captured(scene, rays, ends, name, bounced=bounced, dark=dark, lists=lists)
        self._launcher.run_banded(kernels.choose_hits, len(rays.t_max), rays, relit, captured)
        return captured

    def find_emitted(
        self, scene: DeviceScene, rays: RayData, limits: wp.array[float], marked: DeviceArray, name: str
    ) -> GaussianHits:
        """Returns the radiance of emissive captures on secondary rays; also separately for flagged captures.

        Rays end at relit surfaces, and where their transmittance falls to `EMITTER_OPAQUE`.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            limits: Distances at which rays end, such as those of the nearest meshes.
            marked: Copy of the scene's splat instances whose ``relit`` flag marks the captures to separate.
            name: Name of the buffers that hold the result.
        """
        if scene.plan.relights:
            limits = self._find_relit(scene, rays, limits, name, bounced=True)[1]
        return self._emitted.find(scene, rays, limits, name, bounced=True, sets=SplatSets.CAPTURED, marked=marked)

    def _find_relit(
        self,
        scene: DeviceScene,
        rays: RayData,
        limits: wp.array[float],
        name: str,
        *,
        bounced: bool,
        lists: RayLists | None = None,
    ) -> tuple[GaussianHits, DeviceArray]:
        """Returns each ray's hit on a relit Gaussian, and the distance where the ray ends: the hit, or its limit."""
        inputs = scene, rays, limits, f"{name}.relit"
        relit = self._stochastic.find(*inputs, bounced=bounced, sets=SplatSets.RELIT, lists=lists)
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
        lists: RayLists | None = None,
    ) -> GaussianHits:
        """Returns the radiance of emissive captures, blended in order, on each ray up to its limit."""
        marked = dark.marked if dark else None
        sets = SplatSets.CAPTURED
        hits = self._blended.find(scene, rays, limits, name, bounced=bounced, sets=sets, marked=marked, lists=lists)
        if dark is None:
            return hits
        self._launcher.run_banded(kernels.darken, len(rays.t_max), rays, dark.mirrored, hits)
        return self._buffers.struct(name, GaussianHits, len(rays.t_max), EXTRA_FIELDS)

    def find_captured(self, scene: DeviceScene, rays: RayData, ends: wp.array[float], name: str) -> GaussianHits:
        """Returns the radiance of shadow catchers alone on secondary rays; see `RayTracer.find_captured`."""
        return self._blended.find(scene, rays, ends, name, bounced=True, sets=SplatSets.SHADOW_CATCHERS)


def _with(config: RenderConfig, strategy: TraceStrategy) -> RenderConfig:
    return replace(config, trace=replace(config.trace, strategy=strategy))
