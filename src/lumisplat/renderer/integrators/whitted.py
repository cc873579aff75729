"""Host pass: radiance of primary hits by direct light, specular reflection and refraction (Whitted 1980)."""

from __future__ import annotations

import itertools

from lumisplat.config import RenderConfig
from lumisplat.renderer.integrators.specular_waves import SpecularWaves
from lumisplat.renderer.light.direct_light import DirectLight
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher


class WhittedIntegrator:
    """Computes the radiance of rays, lit or unlit, over all bounces.

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

    def shade(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, sample: int) -> RayWave:
        """The first wave, with the radiance of its rays over all bounces.

        Args:
            scene: The scene on the device, synced.
            plan: Plan of the frame.
            hits: The rays, and what they hit.
            sample: Number of the sample.
        """
        self._direct_light.begin_sample(sample)
        with self._launcher.stage("light" if plan.is_lit else "bounce"):
            waves = [self._shade_wave(scene, plan, hits, 0)]
            while count := self._branch_count(waves[-1]):
                rays, weights = self._specular.spawn(scene, waves[-1], count)
                hits = self._tracer.find_hits(scene, rays, "wave")
                waves.append(self._shade_wave(scene, plan, hits, len(waves), weights))
            for near, far in reversed(list(itertools.pairwise(waves))):
                self._specular.gather(scene, near, far)
        return waves[0]

    def light_images(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> LightImages:
        """The light of each light that the rays of these hits see, if the frame asks for it."""
        return self._direct_light.images(scene, plan, hits.count)

    def _shade_wave(
        self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, number: int, weights: DeviceArray | None = None
    ) -> RayWave:
        """A wave with emission and direct light."""
        may_branch = number < plan.max_bounces and hits.count > 0
        wave = self._surfaces.shade(scene, plan, hits, number, weights=weights, may_branch=may_branch)
        if plan.is_lit:
            self._direct_light.add(scene, plan, wave)
        return wave

    def _branch_count(self, wave: RayWave) -> int:
        """Number of rays of the next wave; 0 if they would exceed ``max_bounces``."""
        return self._specular.count(wave) if wave.row.may_branch else 0
