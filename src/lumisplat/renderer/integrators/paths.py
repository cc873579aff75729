"""Host pass: radiance of primary hits by paths of light, wave by wave (Kajiya 1986; Veach 1997)."""

from __future__ import annotations

import logging

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.path import PathData, PathSteps
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.integrators import path_kernels as kernels
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import Carried, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, grown_capacity
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.primitives import prefix_sum

_log = logging.getLogger("lumisplat")


class PathIntegrator:
    """Computes the radiance of rays by one path each.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of the rays on which paths go on.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._launcher, self._buffers, self._tracer = launcher, buffers, tracer
        self._surfaces = Surfaces(launcher, buffers)
        self._shadows = ShadowRays(launcher, buffers, config)
        self._has_warned = False
        self._without: tuple[str, ...] = ()
        """Fields of paths that the frame does not need."""

    def shade(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, sample: int) -> RayWave:
        """The first wave, with the radiance of its rays.

        Args:
            scene: The scene on the device, synced.
            plan: Plan of the frame.
            hits: The rays, and what they hit.
            sample: Number of the sample.
        """
        self._warn_of_shadow_only(plan)
        self._shadows.begin_sample(sample)
        self._without = () if plan.has_media else ("media",)
        with self._launcher.stage("light"):
            paths = self._begin(hits)
            first = wave = self._wave(scene, plan, hits, paths, 0)
            light = device_array(first.row.radiance.light)
            steps = self._extend(scene, plan, 0, wave=wave, paths=paths, light=light)
            for number in range(1, plan.max_bounces + 2):
                capacity = grown_capacity(int(device_array(steps.places)[-1:].numpy()[0]))
                if capacity == 0:
                    break
                rays, paths = self._spawn(wave, paths, steps, number, capacity)
                hits = self._tracer.find_hits(scene, rays, f"path{number % 2}", bounced=True)
                wave = self._wave(scene, plan, hits, paths, number)
                steps = self._extend(scene, plan, number, wave=wave, paths=paths, light=light)
        return first

    def light_images(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> LightImages:
        """None: paths sample one light at a time."""
        return LightImages()

    def _warn_of_shadow_only(self, plan: FramePlan) -> None:
        """Logs, once, that shadow-only sets stay as captured."""
        if plan.has_shadow_only and not self._has_warned:
            self._has_warned = True
            _log.warning("shadow-only captures take no shadows in Pipeline.PATH: they do with Pipeline.HYBRID")

    def _begin(self, hits: PrimaryHits) -> PathData:
        """One path a ray."""
        paths = self._buffers.struct("path.paths0", PathData, hits.count, self._without)
        self._launcher.run_banded(kernels.begin_paths, hits.count, paths)
        return paths

    def _wave(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, paths: PathData, number: int) -> RayWave:
        """A wave, with what its rays see but for lights, and its interactions."""
        # Two sets of buffers are enough: the first wave's stay, and a later one is done before the next begins.
        carried = Carried(media=device_array(paths.media) if plan.has_media and number > 0 else None)
        return self._surfaces.shade(scene, plan, hits, min(number, 1), carried=carried, may_branch=False)

    def _extend(
        self, scene: DeviceScene, plan: FramePlan, number: int, *, wave: RayWave, paths: PathData, light: DeviceArray
    ) -> PathSteps:
        """Adds what the paths of a wave see, and what lights send there, to the light of the first wave's rays.

        Returns where the paths go on.
        """
        count, run = wave.count, self._launcher.run_banded
        rays = self._buffers.struct("path.shadow_rays", RayData, 2 * count)
        contributions = self._buffers.get("path.contributions", wp.vec3, 2 * count)
        opaque = self._buffers.get("path.opaque", wp.bool, 2 * count)
        steps = self._buffers.struct("path.steps", PathSteps, count, self._without)
        with self._launcher.stage("shade"):
            run(
                kernels.extend_paths,
                count,
                *(number, plan.max_bounces, not plan.casts_shadows, scene.shading, wave.data, paths, light),
                *(rays, opaque, contributions, steps),
                bands=SHADE_BANDS_PER_THREAD * self._launcher.threads,
            )
        visibility = contributions
        if plan.casts_shadows and number <= plan.max_bounces:
            with self._launcher.stage("shadow"):
                visibility = self._shadows.trace(
                    scene, rays, None, "path.visibility", opaque=opaque, of_splats=plan.splat_shadows
                )
        run(kernels.add_direct_light, count, wave.data, paths, rays, contributions, visibility, light)
        prefix_sum(device_array(steps.goes_on), device_array(steps.places), inclusive=True)
        return steps

    def _spawn(
        self, wave: RayWave, paths: PathData, steps: PathSteps, number: int, capacity: int
    ) -> tuple[RayData, PathData]:
        """The rays of the next wave, and their paths."""
        rays = self._buffers.struct(f"path.rays{number % 2}", RayData, capacity)
        rays.is_active.zero_()
        onwards = self._buffers.struct(f"path.paths{number % 2}", PathData, capacity, self._without)
        self._launcher.run_banded(kernels.spawn_paths, wave.count, wave.data, paths, steps, rays, onwards)
        return rays, onwards
