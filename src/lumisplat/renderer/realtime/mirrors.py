"""Reflections and refractions of smooth surfaces in real time (docs/method/realtime.md#mirrors)."""

from __future__ import annotations

import itertools

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.light.direct_light import DirectLight
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.realtime import mirror_kernels as kernels
from lumisplat.renderer.realtime.light_grid import LightGrids
from lumisplat.renderer.realtime.radiance_cache import RadianceCache
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.renderer.trace.specular_waves import SpecularWaves
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher


class Mirrors:
    """Traces reflected and refracted rays as in hybrid frames, and adds indirect light at their hits.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of rays.
        shadows: Traces shadow rays; ``begin_sample`` has been called.
        cache: Radiance cache that provides the indirect light.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        config: RenderConfig,
        *,
        tracer: RayTracer,
        shadows: ShadowRays,
        cache: RadianceCache,
    ) -> None:
        self._launcher, self._buffers, self._tracer = launcher, buffers, tracer
        self._shadows, self._cache = shadows, cache
        self._surfaces = Surfaces(launcher, buffers)
        self._direct_light = DirectLight(launcher, buffers, config)
        self._grids = LightGrids(launcher, buffers)
        self._specular = SpecularWaves(launcher, buffers)
        realtime = config.realtime
        self._jitter_width = realtime.cache.cell_size if realtime.antialiasing else 0.0

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        modules: list[KernelModule] = [
            kernels,
            *self._tracer.modules(plan),
            *self._specular.modules(),
            *self._direct_light.modules(plan),
        ]
        if plan.casts_shadows:
            modules += self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes, incoherent=True)
        return modules

    @property
    def graph_key(self) -> object:
        """Numbers of rays after each bounce for which a CUDA graph has room."""
        return self._specular.graph_key

    def finish(self) -> bool:
        """Waits for the reflected and refracted rays; False if they exceeded their room. Then draw the frame again."""
        return self._specular.finish()

    def begin_frame(self, frame: int) -> None:
        """Begins frame ``frame``: writes its number for shadow rays."""
        self._direct_light.begin_sample(frame)

    def add(self, scene: DeviceScene, plan: FramePlan, first: RayWave) -> DeviceArray:
        """Adds the radiance of reflections and refractions to the camera rays, ``first``.

        Returns:
            The added radiance alone, linear, one vec3 for each ray.
        """
        added = self._buffers.get("mirrors.added", wp.vec3, first.count)
        before = self._buffers.get("mirrors.before", wp.vec3, first.count)
        before.assign(first.row.radiance.light)
        waves = self._waves(scene, plan, first)
        for near, far in reversed(list(itertools.pairwise(waves))):
            self._specular.gather(scene, near, far)
        self._launcher.run_banded(kernels.subtract, first.count, first.data, before, added)
        return added

    def _waves(self, scene: DeviceScene, plan: FramePlan, first: RayWave) -> list[RayWave]:
        """Returns the camera rays, then the reflected and refracted rays after each bounce."""
        waves = [first]
        for number in range(1, plan.max_bounces + 1):
            self._specular.number(waves[-1])
            capacity = self._specular.capacity(waves[-1])
            if capacity == 0:
                break
            rays, carried = self._specular.spawn(scene, plan, waves[-1], capacity)
            hits = self._tracer.find_hits(scene, rays, "wave")
            may_branch = number < plan.max_bounces
            wave = self._surfaces.shade(
                scene, plan, hits, number, carried=carried, may_branch=may_branch, on_paths=False
            )
            self._add_lights(scene, plan, wave)
            self._add_cached(scene, wave)
            waves.append(wave)
        return waves

    def _add_lights(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Adds direct light to rays: from all lights one by one or, with many lights, from those in the light grid."""
        if self._grids.is_needed(scene) and not plan.has_shadow_catchers:
            grid = self._grids.of_wave(scene, wave)
            for slot in range(GRID_LIGHTS + 1):
                self._add_samples(scene, plan, wave, kernels.sample_light_of_cells, slot, not plan.casts_shadows, grid)
            return
        self._direct_light.add(scene, plan, wave)
        if scene.has_emitters and plan.casts_shadows:
            self._add_samples(scene, plan, wave, kernels.sample_emitters)

    def _add_samples(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, sample: Kernel, *inputs: object) -> None:
        """Adds one light sample for each ray; ``sample`` is the kernel that samples, with arguments ``inputs``."""
        count, get, run = wave.count, self._buffers.get, self._launcher.run_banded
        sampled = get("mirrors.sampled", wp.vec3, count)
        rays = self._buffers.struct("mirrors.shadow_rays", RayData, count)
        run(sample, count, *inputs, scene.shading, wave.data, sampled, rays)
        visibility = sampled
        if plan.casts_shadows:
            visibility = self._shadows.trace(
                scene, rays, None, "mirrors.visibility", splat_shadows=plan.splat_shadows, incoherent=True
            )
        run(kernels.add_samples, count, sampled, rays, visibility, wave.data)

    def _add_cached(self, scene: DeviceScene, wave: RayWave) -> None:
        """Adds to rays the indirect light that the radiance cache holds for the surfaces that the rays hit."""
        samples = self._buffers.struct("mirrors.samples", CacheSamples, 2 * wave.count)
        points = self._buffers.get("mirrors.points", wp.vec3, 2 * wave.count)
        inputs = self._jitter_width, scene.camera, wave.data, samples, points
        self._launcher.run_banded(kernels.list_surfaces, 2 * wave.count, *inputs)
        indirect = self._cache.look_up_indirect(samples, points)
        self._launcher.run_banded(kernels.add_cached, wave.count, indirect, wave.data)
