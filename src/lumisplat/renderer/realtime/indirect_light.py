"""Host pass: indirect light of the surfaces that pixels show, by screen probes and the radiance cache."""

from __future__ import annotations

from lumisplat.config import RenderConfig
from lumisplat.constants import PACKET_RAYS
from lumisplat.device.structs.gi import LobeRays, SurfaceLight, SurfacePixels
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.gi.radiance_cache import RadianceCache
from lumisplat.renderer.gi.screen_probes import ScreenProbes
from lumisplat.renderer.realtime import indirect_light_kernels as kernels
from lumisplat.renderer.realtime.bounced_light import BouncedLight
from lumisplat.renderer.realtime.gbuffer import Surfaces
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher


class IndirectLight:
    """Finds the light that surfaces receive from others.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of rays.
        shadows: Follows shadow rays; its sample has begun.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer, shadows: ShadowRays
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._bounced = BouncedLight(launcher, buffers, config, tracer, shadows)
        self._interval = config.realtime.light_interval
        self._offset = config.shadow_rays.offset
        self.cache = RadianceCache(launcher, buffers, config.realtime.cache)
        """What surfaces around reflect."""
        self.probes = ScreenProbes(launcher, buffers, config.realtime.probes, config.seed, self._offset)
        """What sees light from other surfaces."""

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """The kernel modules of a frame."""
        return [*self._bounced.modules(plan), kernels, *self.probes.modules(), *self.cache.modules()]

    def forget(self) -> None:
        """Drops all that earlier frames have found."""
        self.cache.reset()
        self.probes.reset()

    def find(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        surfaces: list[Surfaces],
        highlights: tuple[LobeRays, RayData | None],
        frame: int,
    ) -> list[SurfaceLight]:
        """The light of this frame, for the surfaces of each kind.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            surfaces: What its pixels show.
            highlights: Rays within their highlights.
            frame: Number of the frame.
        """
        with self._launcher.stage("probes"):
            shown = self._shown(surfaces)
            self.probes.place(shown, scene.camera, scene.motion.camera, scene.image_size, frame)
            if scene.motion.known_share < 1.0:
                self.probes.outdate(scene.motion.known_share)
                self.cache.outdate(scene.motion.known_share)
            rays = self.probes.rays(frame)
        hits = self._bounced.find(scene, plan, rays, "probe_rays", sees_lights=False)
        self.cache.insert(hits.samples, frame)
        self._bounce(scene, plan, frame)
        reflected = self.cache.look_up(hits.samples)
        with self._launcher.stage("probes"):
            self.probes.update(*self._bounced.seen(hits, reflected, "probe_rays"))
        lobes = self._follow(scene, plan, *highlights, frame)
        with self._launcher.stage("probes"):
            light = [self._received(scene, kind, lobes) for kind in surfaces]
        self.cache.evict(frame)
        return light

    def _follow(
        self, scene: DeviceScene, plan: FramePlan, lobes: LobeRays, rays: RayData | None, frame: int
    ) -> LobeRays:
        """What the rays within highlights see: by direct light of their own, since cells would show in narrow ones."""
        if rays is not None:
            hits = self._bounced.find(scene, plan, rays, "lobe_rays")
            self.cache.insert(hits.samples, frame)
            reflected = self.cache.look_up_indirect(hits.samples)
            self._launcher.run_banded(kernels.add_direct, len(rays.t_max), hits.samples, reflected)
            lobes.seen, _ = self._bounced.seen(hits, reflected, "lobe_rays")
        return lobes

    def _bounce(self, scene: DeviceScene, plan: FramePlan, frame: int) -> None:
        """Lets light bounce from cell to cell of the cache."""
        points = self.cache.bounce_points(frame)
        count = len(device_array(points.is_active))
        rays = self._buffers.struct("cache.rays", RayData, -(-count // PACKET_RAYS) * PACKET_RAYS)
        with self._launcher.stage("bounced"):
            self._launcher.run_banded(kernels.start_cache_rays, len(rays.t_max), self._offset, points, rays)
        hits = self._bounced.find(scene, plan, rays, "cache_rays")
        self.cache.insert(hits.samples, frame)
        self.cache.add_bounces(
            points, hits.samples, lambda reflected: self._bounced.seen(hits, reflected, "cache_rays")[0]
        )

    def _shown(self, surfaces: list[Surfaces]) -> SurfacePixels:
        """The surface of each pixel that is the most of it."""
        if len(surfaces) == 1:
            return surfaces[0].now
        count = len(device_array(surfaces[0].now.share))
        shown = self._buffers.struct("gbuffer.shown", SurfacePixels, count)
        self._launcher.run_banded(kernels.choose_surfaces, count, surfaces[0].now, surfaces[1].now, shown)
        return shown

    def _received(self, scene: DeviceScene, kind: Surfaces, lobes: LobeRays) -> SurfaceLight:
        """What surfaces of one kind reflect of what the probes and the rays within their highlights see."""
        probes = self.probes
        irradiance = probes.irradiance(kind.now)
        light = self._buffers.struct(f"indirect_light.{kind.kind}", SurfaceLight, len(irradiance))
        seen = probes.grid, scene.camera, kind.now, probes.probes, probes.adaptive_of, probes.light
        inputs = kind.kind, *seen, irradiance, lobes, self._interval, light
        self._launcher.run_banded(kernels.receive_light, len(irradiance), *inputs)
        return light
