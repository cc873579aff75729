"""Host pass: light of captures that are sampled as lights (docs/method/realtime.md#captured-emitters)."""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.gi import PixelLight
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.realtime import captured_light_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan, SplatShadows
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher

_OF_MESHES = SplatShadows(on_reflecting=False, on_shadow_only=False)


class CapturedLights:
    """Samples the light of captures at the surfaces that pixels show, by one ray each.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        shadows: Follows rays through glass; its sample has begun.
        tracer: Finds what rays see.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, shadows: ShadowRays, tracer: RayTracer
    ) -> None:
        self._launcher, self._buffers, self._shadows, self._tracer = launcher, buffers, shadows, tracer
        self._follows_lobes = config.realtime.highlight_rays and config.max_bounces != 0

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """The kernel modules of a frame."""
        if not plan.keeps_captures:
            return []
        return [kernels, *self._shadows.modules(_OF_MESHES, has_meshes=plan.has_meshes)]

    def add(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        wave: RayWave,
        light: PixelLight,
        rays: RayData,
        *,
        visibility: DeviceArray,
    ) -> None:
        """Adds it to the samples of light of pixels, whose own shadow rays count from then on as followed.

        Args:
            scene: The scene on the device.
            plan: Plan of the frame.
            wave: The first wave, its samples numbered.
            light: The samples.
            rays: Their shadow rays; none is active afterwards.
            visibility: What each leaves, where it is active.
        """
        boxes, marked = scene.captured_emitters.boxes, scene.captured_emitters.marked
        if boxes is None or marked is None:
            return
        count, run, get = wave.count, self._launcher.run_banded, self._buffers.get
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        reflected = self._buffers.struct("captured_light", PixelLight, count, {"slot"})
        ways = self._buffers.struct("captured_light.rays", RayData, count)
        with self._launcher.stage("lights"):
            inputs = self._follows_lobes, boxes, scene.shading, wave.data
            run(kernels.start_captured_rays, count, *inputs, light.slot, reflected, ways, bands=bands)
        meshes = self._tracer.find_meshes(scene, ways, "captured_light.meshes")
        ends, is_glass = get("captured_light.ends", wp.float32, count), get("captured_light.is_glass", wp.int32, count)
        run(kernels.end_behind_glass, count, scene.shading, ways, meshes, ends, is_glass)
        seen = self._tracer.find_emitted(scene, ways, ends, marked, "captured_light.seen")
        passed = get("captured_light.passed", wp.vec3, count)
        if plan.max_bounces > 0:  # there may be glass
            run(kernels.start_through_glass, count, is_glass, seen, ways)
            passed = self._shadows.trace(scene, ways, None, "captured_light.passed", of_splats=_OF_MESHES)
        inputs = scene.shading, seen, reflected, is_glass, passed, visibility
        run(kernels.add_captured_light, count, *inputs, light, rays)
