"""Direct light at the surfaces of pixels, with one shadow ray for each pixel.

The method is in docs/method/realtime.md#direct and #captured-emitters.
"""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.light_visibility import LightVisibility
from lumisplat.device.gi.surfaces import FilteredLight, KnownLight, PixelLight, SurfaceLight
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.light.direct_light import DirectLight
from lumisplat.renderer.realtime import captured_emitter_kernels, pixel_light_kernels
from lumisplat.renderer.realtime.gbuffer import MESHES, SPLATS, PixelSurfaces
from lumisplat.renderer.realtime.light_grid import LightGrids
from lumisplat.renderer.realtime.light_visibility import LightVisibilities
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan, SplatShadows
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Kernel, KernelModule, Launcher

_OF_MESHES = SplatShadows(on_reflecting=False, on_shadow_catchers=False)


class PixelLights:
    """Samples direct light from lights, from emissive meshes, and from captures that count as lights.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        shadows: Traces shadow rays; ``begin_sample`` has been called.
        tracer: Finds the hits of rays towards captures.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, shadows: ShadowRays, tracer: RayTracer
    ) -> None:
        self._launcher, self._buffers, self._shadows, self._tracer = launcher, buffers, shadows, tracer
        self._interval, self._is_smoothed = config.realtime.light_interval, config.realtime.filter.passes >= 2
        self._follows_lobes = config.realtime.highlight_rays and config.max_bounces != 0
        self._grids = LightGrids(launcher, buffers)
        self._direct_light = DirectLight(launcher, buffers, config)
        self._visibilities = [
            LightVisibilities(launcher, buffers, config.realtime.filter, kind) for kind in (SPLATS, MESHES)
        ]

        self._remembers = False
        """True if the frame lights surfaces by the remembered visibility of lights."""

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        modules: list[KernelModule] = [pixel_light_kernels, *self._grids.modules(), *LightVisibilities.modules()]
        if plan.has_emissive_captures:
            modules += [captured_emitter_kernels, *self._shadows.modules(_OF_MESHES, has_meshes=plan.has_meshes)]
        if not plan.casts_shadows:
            return modules
        if plan.has_shadow_catchers:
            modules += self._direct_light.modules(plan)
        return [*modules, *self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes)]

    def reset(self) -> None:
        """Begins a new sequence of frames: forgets the visibility of lights."""
        for visibilities in self._visibilities:
            visibilities.reset()

    def sample(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        wave: RayWave,
        surfaces: list[PixelSurfaces],
        *,
        layers: tuple[DeviceArray, DeviceArray],
        parity: int,
    ) -> list[SurfaceLight]:
        """Samples a light for one surface of each pixel that has a sample in this frame.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            wave: The camera rays.
            surfaces: Splat surfaces and mesh surfaces of the pixels, as far as the scene has them.
            layers: Layer of diffuse light and layer of glossy light, to which light of remembered visibility is added.
            parity: Parity of the frame, 0 or 1.

        Returns:
            Samples on each of ``surfaces``.
        """
        count = wave.count
        interval = self._interval
        if scene.captured_emitters.boxes is not None and self._is_smoothed:
            interval = 2  # each sample then traces two rays
        light = self._buffers.struct("pixel_light", PixelLight, count)
        rays = self._buffers.struct("pixel_light.rays", RayData, count)
        inputs = interval, scene.motion.sequence, scene.camera, wave.data
        self._launcher.run_banded(pixel_light_kernels.number_samples, count, *inputs)
        grid = self._grids.of_wave(scene, wave)
        remembered = [LightVisibility(), LightVisibility()]
        with self._launcher.stage("lights"):
            if self._remembers:
                for kind in surfaces:
                    remembered[kind.kind] = self._visibilities[kind.kind].fetch(scene, kind, parity)
            inputs = not plan.casts_shadows, interval, scene.motion.sequence, grid, *remembered, scene.camera
            inputs = *inputs, scene.shading, wave.data, *self._footprints(surfaces), light, rays
            self._run(pixel_light_kernels.sample_lights, count, *inputs)
        visibility = self._visibility(scene, plan, rays)
        known = self.known(scene.image_size, parity)
        for image in (known.diffuse, known.glossy, known.albedo, known.glossy_albedo):
            device_array(image).zero_()
        if self._remembers:
            with self._launcher.stage("visibility"):
                for kind in surfaces:
                    part, before = self._visibilities[kind.kind], remembered[kind.kind]
                    now = part.update(scene, kind, light, rays, visibility=visibility, before=before, parity=parity)
                    inputs = scene, wave, kind, now
                    part.add(*inputs, known=known, layers=layers, no_shadows=not plan.casts_shadows)
        self._add_captured(scene, plan, wave, light, rays, visibility=visibility, known=known)
        with self._launcher.stage("lights"):
            return [self._store(scene, kind, light, rays, visibility) for kind in surfaces]

    def begin_frame(self, scene: DeviceScene, frame: int) -> bool:
        """Begins frame ``frame``: writes its number for shadow rays from shadow catchers.

        Returns:
            True if the filtered samples of earlier frames hold the light of other lights than those of this frame,
            because only one of both frames remembers the visibility of lights.
        """
        self._direct_light.begin_sample(frame)
        before, self._remembers = self._remembers, self._remembered_lights(scene) > 0
        for visibilities in self._visibilities:
            if self._remembers:
                visibilities.begin_frame(self._remembered_lights(scene), frame % 2)
            else:
                visibilities.reset()
        return before != self._remembers

    def known(self, size: tuple[int, int], parity: int) -> KnownLight:
        """Returns the known light of the frame of this parity, whose images have ``size``."""
        return self._buffers.struct(f"pixel_light.known{parity % 2}", KnownLight, size[0] * size[1])

    def graph_key(self, parity: int) -> object:
        """Returns what a CUDA graph of a frame of this parity contains of the visibilities of the frame before."""
        return [visibilities.lights_before(parity) for visibilities in self._visibilities]

    def _remembered_lights(self, scene: DeviceScene) -> int:
        """Returns the number of lights, some of whose visibility is remembered; 0 if surfaces use the light grid."""
        return 0 if self._grids.is_needed(scene) else len(scene.motion.light_before)

    def darken(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Darkens shadow catchers where lights are blocked.

        All interactions that are not on shadow catchers are deleted.
        """
        self._launcher.run_banded(pixel_light_kernels.select_shadow_catchers, 2 * wave.count, wave.data)
        self._direct_light.add(scene, plan, wave)

    def add(
        self,
        scene: DeviceScene,
        wave: RayWave,
        kind: PixelSurfaces,
        light: FilteredLight,
        layers: tuple[DeviceArray, DeviceArray],
    ) -> None:
        """Adds the filtered light on splat surfaces, or on mesh surfaces, to the camera rays and to two layers.

        Args:
            scene: The scene on the device.
            wave: The camera rays.
            kind: The splat surfaces or the mesh surfaces.
            light: Filtered light that these surfaces reflect.
            layers: Layer of diffuse light and layer of glossy light, one element for each ray.
        """
        inputs = scene.camera, wave.data, kind.now, light, *layers
        self._launcher.run_banded(pixel_light_kernels.add_surface_light, wave.count, *inputs)

    def _footprints(self, surfaces: list[PixelSurfaces]) -> tuple[DeviceArray, DeviceArray]:
        """Returns how far the normals within pixels widen highlights, of splat surfaces and of mesh surfaces."""
        found = {kind.kind: device_array(kind.now.footprint) for kind in surfaces}
        none = self._buffers.get("pixel_light.no_footprint", wp.float32, 0)
        return found.get(SPLATS, none), found.get(MESHES, none)

    def _visibility(self, scene: DeviceScene, plan: FramePlan, rays: RayData) -> DeviceArray:
        if not plan.casts_shadows:
            return self._buffers.get("pixel_light.visibility", wp.vec3, len(rays.t_max))
        with self._launcher.stage("shadow"):
            return self._shadows.trace(scene, rays, None, "pixel_light.visibility", splat_shadows=plan.splat_shadows)

    def _add_captured(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        wave: RayWave,
        light: PixelLight,
        rays: RayData,
        *,
        visibility: DeviceArray,
        known: KnownLight,
    ) -> None:
        """Adds the light of captures that count as lights, with at most one ray for each light sample.

        Afterwards, the samples include the ``visibility`` of their shadow rays, and no shadow ray is active.
        """
        kernels, count, get = captured_emitter_kernels, wave.count, self._buffers.get
        boxes, marked = scene.captured_emitters.boxes, scene.captured_emitters.marked
        if boxes is None or marked is None:
            return
        reflected = self._buffers.struct("captured_light", PixelLight, count, {"slot", "light", "ratio"})
        sent = self._buffers.struct("captured_light.rays", RayData, count)
        with self._launcher.stage("lights"):
            inputs = self._follows_lobes, boxes, scene.camera, scene.shading, wave.data
            self._run(kernels.start_captured_rays, count, *inputs, light.slot, known, reflected, sent)
        meshes = self._tracer.find_meshes(scene, sent, "captured_light.meshes")
        ends, is_glass = get("captured_light.ends", wp.float32, count), get("captured_light.is_glass", wp.int32, count)
        run = self._launcher.run_banded
        run(kernels.end_behind_glass, count, scene.shading, sent, meshes, ends, is_glass)
        emitted = self._tracer.find_emitted(scene, sent, ends, marked, "captured_light.seen")
        passed = get("captured_light.passed", wp.vec3, count)
        if plan.max_bounces > 0:  # glass may tint the light
            run(kernels.start_through_glass, count, is_glass, emitted, sent)
            passed = self._shadows.trace(scene, sent, None, "captured_light.passed", splat_shadows=_OF_MESHES)
        inputs = scene.shading, emitted, reflected, is_glass, passed, visibility
        run(kernels.add_captured_light, count, *inputs, light, rays)

    def _store(
        self, scene: DeviceScene, kind: PixelSurfaces, light: PixelLight, rays: RayData, visibility: DeviceArray
    ) -> SurfaceLight:
        width, height = scene.image_size
        sampled = self._buffers.struct(f"surface_light.{kind.kind}", SurfaceLight, width * height)
        inputs = kind.kind, scene.camera, light, rays, visibility, kind.now.albedo, sampled
        self._launcher.run_banded(pixel_light_kernels.store_light, len(rays.t_max), *inputs)
        return sampled

    def _run(self, kernel: Kernel, count: int, *inputs: object) -> None:
        self._launcher.run_banded(kernel, count, *inputs, bands=SHADE_BANDS_PER_THREAD * self._launcher.threads)
