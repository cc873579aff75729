"""Host pass: direct light of the surfaces that pixels show, by one shadow ray a pixel."""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.gi import FilteredLight, PixelLight, SurfaceLight
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.gi.light_grid import LightGrids
from lumisplat.renderer.light.direct_light import DirectLight
from lumisplat.renderer.realtime import pixel_light_kernels as kernels
from lumisplat.renderer.realtime.captured_light import CapturedLights
from lumisplat.renderer.realtime.gbuffer import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher


class PixelLights:
    """Samples direct light.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        shadows: Follows shadow rays; its sample has begun.
        tracer: Finds what rays to captures see.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, shadows: ShadowRays, tracer: RayTracer
    ) -> None:
        self._launcher, self._buffers, self._shadows = launcher, buffers, shadows
        self._interval, self._is_smoothed = config.realtime.light_interval, config.realtime.filter.passes >= 2
        self._grids = LightGrids(launcher, buffers)
        self._direct_light = DirectLight(launcher, buffers, config)
        self._captured = CapturedLights(launcher, buffers, config, shadows, tracer)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """The kernel modules of a frame."""
        modules: list[KernelModule] = [kernels, *self._grids.modules(), *self._captured.modules(plan)]
        if not plan.casts_shadows:
            return modules
        if plan.has_shadow_only:
            modules += self._direct_light.modules(plan)
        return [*modules, *self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes)]

    def sample(
        self, scene: DeviceScene, plan: FramePlan, wave: RayWave, surfaces: list[Surfaces], frame: int
    ) -> list[SurfaceLight]:
        """One sample of the light of each pixel whose turn it is, for one of its surfaces; those of each kind.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            wave: The first wave.
            surfaces: What its pixels show.
            frame: Number of the frame.
        """
        count, run = wave.count, self._launcher.run_banded
        interval = self._interval
        if scene.captured_emitters.boxes is not None and self._is_smoothed:
            interval = 2  # a sample has two rays then
        light = self._buffers.struct("pixel_light", PixelLight, count)
        rays = self._buffers.struct("pixel_light.rays", RayData, count)
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        run(kernels.number_samples, count, interval, frame, scene.camera, wave.data)
        grid = self._grids.of_wave(scene, wave)
        with self._launcher.stage("lights"):
            inputs = not plan.casts_shadows, interval, frame, grid, scene.camera
            inputs = *inputs, scene.shading, wave.data, light, rays
            run(kernels.sample_lights, count, *inputs, bands=bands)
        visibility = self._visibility(scene, plan, rays)
        self._captured.add(scene, plan, wave, light, rays, visibility=visibility)
        with self._launcher.stage("lights"):
            return [self._store(scene, kind, light, rays, visibility) for kind in surfaces]

    def darken(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, sample: int) -> None:
        """Writes what shadows leave of captures that are shadow-only; the wave's other interactions are gone then.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            wave: The first wave.
            sample: Number of the frame.
        """
        self._launcher.run_banded(kernels.keep_shadow_only, 2 * wave.count, wave.data)
        self._direct_light.begin_sample(sample)
        self._direct_light.add(scene, plan, wave)

    def add(
        self,
        scene: DeviceScene,
        wave: RayWave,
        kind: Surfaces,
        light: FilteredLight,
        layers: tuple[DeviceArray, DeviceArray],
    ) -> None:
        """Adds filtered light of one kind of surfaces to what rays see.

        Args:
            scene: The scene on the device.
            wave: The first wave.
            kind: The surfaces.
            light: What they reflect.
            layers: Diffuse and glossy, one element a ray; receive the same.
        """
        inputs = scene.camera, wave.data, kind.now, light, *layers
        self._launcher.run_banded(kernels.add_surface_light, wave.count, *inputs)

    def _visibility(self, scene: DeviceScene, plan: FramePlan, rays: RayData) -> DeviceArray:
        if not plan.casts_shadows:
            return self._buffers.get("pixel_light.visibility", wp.vec3, len(rays.t_max))
        with self._launcher.stage("shadow"):
            return self._shadows.trace(scene, rays, None, "pixel_light.visibility", of_splats=plan.splat_shadows)

    def _store(
        self, scene: DeviceScene, kind: Surfaces, light: PixelLight, rays: RayData, visibility: DeviceArray
    ) -> SurfaceLight:
        width, height = scene.image_size
        sampled = self._buffers.struct(f"surface_light.{kind.kind}", SurfaceLight, width * height)
        inputs = kind.kind, scene.camera, light, rays, visibility, kind.now.albedo, sampled
        self._launcher.run_banded(kernels.store_light, len(rays.t_max), *inputs)
        return sampled
