"""Indirect light at the surfaces of pixels, from screen probes and the radiance cache.

Secondary rays start at probes, at cache cells and within highlights (docs/method/realtime.md#rays).
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import PACKET_RAYS, SHADE_BANDS_PER_THREAD
from lumisplat.device.gi.radiance_cache import CacheSamples
from lumisplat.device.gi.secondary_rays import BouncedRays, LobeRays, OnwardRays
from lumisplat.device.gi.surfaces import SurfaceLight, SurfacePixels
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.realtime import indirect_light_kernels as kernels, secondary_ray_kernels as ray_kernels
from lumisplat.renderer.realtime.gbuffer import PixelSurfaces
from lumisplat.renderer.realtime.light_grid import LightGrids
from lumisplat.renderer.realtime.radiance_cache import RadianceCache
from lumisplat.renderer.realtime.screen_probes import ScreenProbes
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.path_gaussians import DarkenedCaptures
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import CarriedState, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum

SPECULAR_WAVES = 8
"""Largest number of smooth surfaces in a row that reflect or transmit a secondary ray; two panes are four surfaces."""


class IndirectLight:
    """Computes the indirect light at the surfaces of pixels.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of rays.
        shadows: Traces shadow rays; ``begin_sample`` has been called.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer, shadows: ShadowRays
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._interval, self._follows_lobes = config.realtime.light_interval, config.realtime.highlight_rays
        self._offset = config.shadow_rays.offset
        self.cache = RadianceCache(launcher, buffers, config.realtime.cache)
        self._rays = SecondaryRays(launcher, buffers, tracer, shadows, self.cache)
        self.probes = ScreenProbes(launcher, buffers, config.realtime.probes, config.seed, self._offset)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        return [*self._rays.modules(plan), kernels, *self.probes.modules(), *self.cache.modules()]

    def begin_frame(self, scene: DeviceScene, frame: int) -> None:
        """Begins frame ``frame`` of a sequence."""
        self.probes.begin(scene.image_size, frame, scene.motion.size_before, scene.motion.image_before)
        self.cache.warn_of_overflow()  # in the frame before, if it was replayed from a graph

    def start_lobes(self, scene: DeviceScene, wave: RayWave) -> tuple[LobeRays, RayData | None]:
        """Starts rays within the specular lobes of the surfaces at pixels, before later rays overwrite the surfaces.

        Returns:
            The struct that stores which pixels have a ray; the rays, or None if no pixel has one.
        """
        width, height = scene.image_size
        squares = -(-width // 2) * -(-height // 2)
        run = self._launcher.run_banded
        lobes = self._buffers.struct("lobes", LobeRays, squares, without={"radiance"})
        if not self._follows_lobes:
            device_array(lobes.slot).fill_(-1)
            return lobes, None
        follows, ends = (self._buffers.get(f"lobes.{name}", wp.int32, squares) for name in ("follows", "ends"))
        run(ray_kernels.choose_lobes, squares, scene.motion.sequence, scene.camera, wave.data, lobes, follows)
        prefix_sum(follows, ends, inclusive=True)
        capacity = self._launcher.capacity_of(ends)
        if capacity == 0:
            return lobes, None
        rays = self._buffers.struct("lobes.rays", RayData, capacity)
        rays.is_active.zero_()
        run(ray_kernels.start_lobes, squares, scene.camera, wave.data, ends, lobes, rays)
        return lobes, rays

    def find(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        surfaces: list[PixelSurfaces],
        lobes: tuple[LobeRays, RayData | None],
    ) -> list[SurfaceLight]:
        """Computes a frame's indirect light, separately on splat surfaces and on mesh surfaces.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            surfaces: Splat surfaces and mesh surfaces of the pixels, as far as the scene has them.
            lobes: Result of `start_lobes`: rays within the highlights of the surfaces.
        """
        sequence = scene.motion.sequence
        with self._launcher.stage("probes"):
            larger = self._larger(surfaces)
            self.probes.place(larger, scene.camera, scene.motion.camera)
            if self._launcher.is_parallel or scene.motion.history_weight < 1.0:
                self.probes.outdate(sequence)
                self.cache.outdate(sequence)
            rays = self.probes.rays()
        hits = self._rays.trace(scene, plan, rays, "probe_rays", hits_emitters=False)
        self.cache.insert(hits.samples, sequence)
        self._bounce(scene, plan)
        reflected = self.cache.look_up(hits.samples)
        with self._launcher.stage("probes"):
            self.probes.update(*self._rays.radiance(hits, reflected, "probe_rays"))
        lobe_rays = self._follow_lobes(scene, plan, *lobes)
        with self._launcher.stage("probes"):
            light = [self._gathered(scene, kind, lobe_rays) for kind in surfaces]
        self.cache.evict(sequence)
        return light

    def _follow_lobes(self, scene: DeviceScene, plan: FramePlan, lobes: LobeRays, rays: RayData | None) -> LobeRays:
        """Traces the rays within specular lobes, and stores their radiance in ``lobes``.

        Direct light at the rays' hits is sampled. The radiance cache is not read, because its cells would be visible in
        narrow highlights.
        """
        if rays is not None:
            hits = self._rays.trace(scene, plan, rays, "lobe_rays")
            self.cache.insert(hits.samples, scene.motion.sequence)
            reflected = self.cache.look_up_indirect(hits.samples)
            self._launcher.run_banded(kernels.add_direct, len(rays.t_max), hits.samples, reflected)
            lobes.radiance, _ = self._rays.radiance(hits, reflected, "lobe_rays")
        return lobes

    def _bounce(self, scene: DeviceScene, plan: FramePlan) -> None:
        """Traces rays from cells of the radiance cache to other cells, so that light bounces from cell to cell."""
        points = self.cache.bounce_points(scene.motion.sequence)
        count = len(device_array(points.is_active))
        rays = self._buffers.struct("cache.rays", RayData, -(-count // PACKET_RAYS) * PACKET_RAYS)
        with self._launcher.stage("bounced"):
            self._launcher.run_banded(kernels.start_cache_rays, len(rays.t_max), self._offset, points, rays)
        hits = self._rays.trace(scene, plan, rays, "cache_rays")
        self.cache.insert(hits.samples, scene.motion.sequence)
        self.cache.add_bounces(
            points, hits.samples, lambda reflected: self._rays.radiance(hits, reflected, "cache_rays")[0]
        )

    def _larger(self, surfaces: list[PixelSurfaces]) -> SurfacePixels:
        """Returns, for each pixel, the surface of Gaussians or the mesh surface, whichever covers more of the pixel."""
        if len(surfaces) == 1:
            return surfaces[0].now
        count = len(device_array(surfaces[0].now.share))
        larger = self._buffers.struct("gbuffer.larger", SurfacePixels, count)
        self._launcher.run_banded(kernels.choose_surfaces, count, surfaces[0].now, surfaces[1].now, larger)
        return larger

    def _gathered(self, scene: DeviceScene, kind: PixelSurfaces, lobes: LobeRays) -> SurfaceLight:
        """Returns the indirect light that splat (or mesh) surfaces reflect, from probes and from rays in lobes."""
        probes = self.probes
        irradiance = probes.irradiance(kind.now)
        light = self._buffers.struct(f"indirect_light.{kind.kind}", SurfaceLight, len(irradiance))
        inputs = kind.kind, probes.grid, scene.camera, kind.now, probes.probes, probes.adaptive_of, probes.light
        inputs = *inputs, irradiance, lobes, self._interval, light
        self._launcher.run_banded(kernels.gather_light, len(irradiance), *inputs)
        return light


@dataclass(frozen=True, slots=True)
class SecondaryHits:
    """Hits of secondary rays, with their direct light."""

    rays: BouncedRays
    samples: CacheSamples
    """Surfaces at the hits, and the direct light and environment light that the surfaces reflect."""


class SecondaryRays:
    """Traces rays that leave surfaces, and samples direct light at the surfaces that the rays hit."""

    def __init__(
        self, launcher: Launcher, buffers: Buffers, tracer: RayTracer, shadows: ShadowRays, cache: RadianceCache
    ) -> None:
        self._launcher, self._buffers, self._tracer, self._shadows = launcher, buffers, tracer, shadows
        self._cache = cache
        self._surfaces = Surfaces(launcher, buffers)
        self._grids = LightGrids(launcher, buffers)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches in a frame."""
        modules: list[KernelModule] = [ray_kernels, *self._surfaces.modules(), *self._grids.modules()]
        modules += self._tracer.modules(plan, bounced=True)
        if plan.casts_shadows:
            modules += self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes, incoherent=True)
        return modules

    def trace(
        self, scene: DeviceScene, plan: FramePlan, rays: RayData, name: str, *, hits_emitters: bool = True
    ) -> SecondaryHits:
        """Finds the surfaces that rays hit, and samples direct light there. Smooth surfaces reflect or transmit rays.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            rays: The rays, a multiple of ``PACKET_RAYS``.
            name: Name of the buffers that hold the result.
            hits_emitters: Whether the rays hit captures that are sampled as lights. False for rays from surfaces that
                already sample these captures.
        """
        count, run = len(rays.t_max), self._launcher.run_banded
        samples = self._buffers.struct(f"{name}.samples", CacheSamples, count)
        bounced = self._buffers.struct(f"{name}.bounced", BouncedRays, count)
        shadow_rays = self._buffers.struct(f"{name}.shadow_rays", RayData, count)
        found = samples, bounced, shadow_rays
        run(ray_kernels.clear_rays, count, *found)
        goes_on = plan.max_bounces > 0
        onward = self._onward(plan, count) if goes_on else OnwardRays()
        media = device_array(onward.media) if plan.has_media else None
        carried = CarriedState(device_array(onward.weights), media) if goes_on else None
        marked, mirrored = scene.captured_emitters.marked, device_array(onward.mirrored) if goes_on else None
        dark = None if hits_emitters or marked is None else DarkenedCaptures(marked, mirrored)
        for number in range(1 + SPECULAR_WAVES * goes_on):
            hits = self._tracer.find_hits(scene, rays, name, bounced=True, dark=dark)
            with self._launcher.stage("bounced"):
                table = f"{name}.wave{min(number, 1)}"  # onward rays have the same arrays after each bounce
                wave = self._surfaces.shade(scene, plan, hits, 1, carried=carried, may_branch=False, table=table)
                grid = self._grids.of_wave(scene, wave)
                inputs = not plan.casts_shadows, grid, self._cache.grid, self._cache.tiles, scene.camera
                inputs = *inputs, scene.shading, wave.data, *found, onward
                run(ray_kernels.shade_hits, count, *inputs, bands=SHADE_BANDS_PER_THREAD * self._launcher.threads)
            if not goes_on or not (self._launcher.is_parallel or self._any_continues(onward)):
                break
            rays = onward.rays
        with self._launcher.stage("bounced"):
            visibility = bounced.sampled
            if plan.casts_shadows:
                visibility = self._shadows.trace(
                    scene, shadow_rays, None, f"{name}.visibility", splat_shadows=plan.splat_shadows, incoherent=True
                )
            run(ray_kernels.apply_visibility, count, bounced, shadow_rays, visibility, samples)
        return SecondaryHits(bounced, samples)

    def radiance(self, hits: SecondaryHits, reflected: DeviceArray, name: str) -> tuple[DeviceArray, DeviceArray]:
        """Returns the linear radiance of the rays, and the distances of their hits (inf without a hit).

        Args:
            hits: Hits of the rays.
            reflected: Linear radiance that the surfaces at the hits reflect from all light.
            name: Name of the buffers that hold the result.
        """
        count = len(reflected)
        radiance = self._buffers.get(f"{name}.radiance", wp.vec3, count)
        distance = self._buffers.get(f"{name}.distance", wp.float32, count)
        inputs = hits.rays, hits.samples, reflected, radiance, distance
        self._launcher.run_banded(ray_kernels.add_reflected, count, *inputs)
        return radiance, distance

    def _onward(self, plan: FramePlan, count: int) -> OnwardRays:
        """Returns the initial state, in air and weight 1, of ``count`` rays that may continue at smooth surfaces."""
        onward, get = OnwardRays(), self._buffers.get
        onward.rays = self._buffers.struct("bounced.onward", RayData, count)
        onward.goes_on = get("bounced.goes_on", wp.int32, count)
        onward.length_before, onward.mirrored = (
            get("bounced.path_length", wp.float32, count),
            get("bounced.mirrored", wp.int32, count),
        )
        onward.weights = get("bounced.weights", wp.vec3, count)
        if plan.has_media:
            onward.media = get("bounced.media", wp.vec4i, count)
        self._launcher.run_banded(ray_kernels.begin_onward, count, onward)
        return onward

    def _any_continues(self, onward: OnwardRays) -> bool:
        """Returns whether a smooth surface reflects or transmits any ray onwards.

        The host waits for the answer. CUDA's schedule does not ask, and launches all waves.
        """
        goes_on = device_array(onward.goes_on)
        ends = self._buffers.get("bounced.ends", wp.int32, len(goes_on))
        prefix_sum(goes_on, ends, inclusive=True)
        return int(ends[-1:].numpy()[0]) > 0
