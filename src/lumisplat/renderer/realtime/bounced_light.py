"""Host pass: what rays see that leave surfaces in real time (docs/method/realtime.md#rays)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.constants.realtime import SPECULAR_WAVES
from lumisplat.device.structs.gi import BouncedRays, OnwardRays
from lumisplat.device.structs.radiance_cache import CacheSamples
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.gi.light_grid import LightGrids
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.realtime import bounced_light_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.path_gaussians import Dark
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import Carried
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum


@dataclass(frozen=True, slots=True)
class BouncedHits:
    """What rays have met."""

    rays: BouncedRays
    samples: CacheSamples
    """The surfaces, and the light that they reflect of lamps and sky."""


class BouncedLight:
    """Traces and shades rays that leave surfaces.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds their hits.
        shadows: Follows shadow rays; its sample has begun.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer, shadows: ShadowRays
    ) -> None:
        self._launcher, self._buffers, self._tracer, self._shadows = launcher, buffers, tracer, shadows
        self._surfaces = Surfaces(launcher, buffers)
        self._grids = LightGrids(launcher, buffers)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """The kernel modules of a frame."""
        modules = [
            kernels,
            *self._surfaces.modules(),
            *self._grids.modules(),
            *self._tracer.modules(plan, bounced=True),
        ]
        if plan.casts_shadows:
            modules += self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes, part=True)
        return modules

    def find(
        self, scene: DeviceScene, plan: FramePlan, rays: RayData, name: str, *, sees_lights: bool = True
    ) -> BouncedHits:
        """What rays meet, with direct light there; at smooth surfaces they go on.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            rays: A multiple of ``PACKET_RAYS``.
            name: Of the buffers that hold the result.
            sees_lights: Whether rays see captures that are sampled as lights, as others; not where they start from
                surfaces that receive the light of these besides.
        """
        count, run = len(rays.t_max), self._launcher.run_banded
        samples = self._buffers.struct(f"{name}.samples", CacheSamples, count)
        bounced = self._buffers.struct(f"{name}.bounced", BouncedRays, count)
        shadow_rays = self._buffers.struct(f"{name}.shadow_rays", RayData, count)
        found = samples, bounced, shadow_rays
        run(kernels.clear_bounced, count, *found)
        goes_on = plan.max_bounces > 0
        onward = self._onward(plan, count) if goes_on else OnwardRays()
        media = device_array(onward.media) if plan.has_media else None
        carried = Carried(device_array(onward.weights), media) if goes_on else None
        marked, mirrored = scene.captured_emitters.marked, device_array(onward.mirrored) if goes_on else None
        dark = None if sees_lights or marked is None else Dark(marked, mirrored)
        for _ in range(1 + SPECULAR_WAVES * goes_on):
            hits = self._tracer.find_hits(scene, rays, name, bounced=True, dark=dark)
            with self._launcher.stage("bounced"):
                wave = self._surfaces.shade(scene, plan, hits, 1, carried=carried, may_branch=False)
                grid = self._grids.of_wave(scene, wave)
                inputs = not plan.casts_shadows, grid, scene.camera, scene.shading, wave.data, *found, onward
                run(kernels.meet_surfaces, count, *inputs, bands=SHADE_BANDS_PER_THREAD * self._launcher.threads)
            if not goes_on or self._number(onward) == 0:
                break
            rays = onward.rays
        with self._launcher.stage("bounced"):
            visibility = bounced.sampled
            if plan.casts_shadows:
                visibility = self._shadows.trace(
                    scene, shadow_rays, None, f"{name}.visibility", of_splats=plan.splat_shadows, part=True
                )
            run(kernels.light_samples, count, bounced, shadow_rays, visibility, samples)
        return BouncedHits(bounced, samples)

    def _onward(self, plan: FramePlan, count: int) -> OnwardRays:
        """Rays that may go on at smooth surfaces, at their beginning."""
        onward, get = OnwardRays(), self._buffers.get
        onward.rays = self._buffers.struct("bounced.onward", RayData, count)
        onward.goes_on = get("bounced.goes_on", wp.int32, count)
        onward.way, onward.mirrored = get("bounced.way", wp.float32, count), get("bounced.mirrored", wp.int32, count)
        onward.weights = get("bounced.weights", wp.vec3, count)
        if plan.has_media:
            onward.media = get("bounced.media", wp.vec4i, count)
        self._launcher.run_banded(kernels.begin_onward, count, onward)
        return onward

    def _number(self, onward: OnwardRays) -> int:
        """How many rays go on. The host waits for it."""
        goes_on = device_array(onward.goes_on)
        ends = self._buffers.get("bounced.ends", wp.int32, len(goes_on))
        prefix_sum(goes_on, ends, inclusive=True)
        return int(ends[-1:].numpy()[0])

    def seen(self, hits: BouncedHits, reflected: DeviceArray, name: str) -> tuple[DeviceArray, DeviceArray]:
        """Radiance of the rays, linear, and the distances of what they meet; inf: nothing.

        Args:
            hits: What they meet.
            reflected: What that reflects of all light, linear.
            name: Of the buffers that hold the result.
        """
        count = len(reflected)
        radiance = self._buffers.get(f"{name}.radiance", wp.vec3, count)
        distance = self._buffers.get(f"{name}.distance", wp.float32, count)
        inputs = hits.rays, hits.samples, reflected, radiance, distance
        self._launcher.run_banded(kernels.add_reflected, count, *inputs)
        return radiance, distance
