"""Radiance of camera rays by direct light, specular reflection and refraction (Whitted 1980).

A wave is all rays after the same number of reflections and refractions.
"""

from __future__ import annotations

import itertools

from lumisplat.config import RenderConfig
from lumisplat.renderer.integrators.sample_integrator import SampleIntegrator
from lumisplat.renderer.light.direct_light import DirectLight
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import CarriedState, LightImages, RayWave
from lumisplat.renderer.trace.specular_waves import SpecularWaves
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher


class WhittedIntegrator(SampleIntegrator):
    """Computes the radiance of rays, lit or unlit, following reflection and refraction over all bounces.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of reflected and refracted rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._launcher, self._tracer = launcher, tracer
        self._surfaces = Surfaces(launcher, buffers)
        self._direct_light = DirectLight(launcher, buffers, config)
        self._specular = SpecularWaves(launcher, buffers)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules of a frame, without the modules that find primary hits."""
        modules = self._surfaces.modules()
        if plan.is_lit:
            modules += self._direct_light.modules(plan)
        if plan.max_bounces:
            modules += [*self._specular.modules(), *self._tracer.modules(plan, bounced=plan.has_lobes)]
        return modules

    def begin_sample(self, scene: DeviceScene, sample: int) -> None:
        """Begins sample ``sample`` of the frame: writes to the device what changes from sample to sample."""
        self._direct_light.begin_sample(sample)

    def graph_key(self, scene: DeviceScene) -> object:
        """Returns the capacities of waves, which a recorded CUDA graph of `shade` contains."""
        return self._specular.graph_key

    def shade(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> RayWave:
        """Returns the camera rays with their radiance over all bounces.

        Args:
            scene: The device scene, synced.
            plan: Plan of the frame.
            hits: The rays and their hits.
        """
        with self._launcher.stage("light" if plan.is_lit else "bounce"):
            return self._follow(scene, plan, hits)

    def is_complete(self, plan: FramePlan) -> bool:
        """Returns whether all waves of the last `shade` had room for their rays."""
        return plan.max_bounces == 0 or self._specular.finish()

    def light_images(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> LightImages:
        """Returns the direct light of each light at the primary hits, if the frame requests it."""
        return self._direct_light.images(scene, plan, hits.count)

    def _follow(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> RayWave:
        """Shades the camera rays, and the rays of each bounce; returns the camera rays with all radiance."""
        waves = [self._shade_wave(scene, plan, hits, 0)]
        while waves[-1].row.may_branch and (capacity := self._specular.capacity(waves[-1])):
            waves.append(self._next_wave(scene, plan, waves[-1], capacity))
        for near, far in reversed(list(itertools.pairwise(waves))):
            self._specular.gather(scene, near, far)
        return waves[0]

    def _next_wave(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, capacity: int) -> RayWave:
        """Returns the rays that leave ``wave``, up to ``capacity``, with their emission and direct light."""
        number = wave.number + 1
        rays, carried = self._specular.spawn(scene, plan, wave, capacity)
        hits = self._tracer.find_hits(scene, rays, "wave", bounced=plan.has_lobes and number == 1)
        return self._shade_wave(scene, plan, hits, number, carried)

    def _shade_wave(
        self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, number: int, carried: CarriedState | None = None
    ) -> RayWave:
        """Returns rays after ``number`` bounces with emission and direct light; numbers the rays that branch off."""
        may_branch = number < plan.max_bounces and hits.count > 0
        wave = self._surfaces.shade(scene, plan, hits, number, carried=carried, may_branch=may_branch)
        if plan.is_lit:
            self._direct_light.add(scene, plan, wave)
        if may_branch:
            self._specular.number(wave)
        return wave
