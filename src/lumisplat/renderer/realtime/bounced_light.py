"""Host pass: what rays see that leave surfaces in real time (docs/method/realtime.md#rays)."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.gi import BouncedRays
from lumisplat.device.structs.radiance_cache import CacheSamples
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.gi.light_grid import LightGrids
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.realtime import bounced_light_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher


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

    def find(self, scene: DeviceScene, plan: FramePlan, rays: RayData, name: str) -> BouncedHits:
        """What rays meet, with direct light there.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            rays: A multiple of ``PACKET_RAYS``.
            name: Of the buffers that hold the result.
        """
        hits = self._tracer.find_hits(scene, rays, name, bounced=True)
        count, run = hits.count, self._launcher.run_banded
        samples = self._buffers.struct(f"{name}.samples", CacheSamples, count)
        bounced = self._buffers.struct(f"{name}.bounced", BouncedRays, count)
        shadow_rays = self._buffers.struct(f"{name}.shadow_rays", RayData, count)
        with self._launcher.stage("bounced"):
            wave = self._surfaces.shade(scene, plan, hits, 1, may_branch=False)
            grid = self._grids.of_wave(scene, wave)
            inputs = not plan.casts_shadows, grid, scene.camera, scene.shading, wave.data, samples, bounced, shadow_rays
            run(kernels.meet_surfaces, count, *inputs, bands=SHADE_BANDS_PER_THREAD * self._launcher.threads)
            visibility = bounced.sampled
            if plan.casts_shadows:
                visibility = self._shadows.trace(
                    scene, shadow_rays, None, f"{name}.visibility", of_splats=plan.splat_shadows, part=True
                )
            run(kernels.light_samples, count, bounced, shadow_rays, visibility, samples)
        return BouncedHits(bounced, samples)

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
