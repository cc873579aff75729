"""Host pass: direct light at the interactions of a wave, with shadow rays to every light that is shadowed."""

from __future__ import annotations

from typing import Any

import warp as wp

from lumisplat.config import RenderConfig, Shadows
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Arrivals
from lumisplat.renderer.light import direct_light_kernels as kernels
from lumisplat.renderer.light import unshadowed_light_kernels
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import LightEnvironment


class DirectLight:
    """Lights waves.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._shadows = ShadowRays(launcher, buffers, config)

    def begin_sample(self, sample: int) -> None:
        """Before the waves of a sample."""
        self._shadows.begin_sample(sample)

    def add(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Adds what all lights give a wave by way of its interactions."""
        # A shadow is a share of all light: where sets are only darkened, unshadowed lights count, too.
        one_by_one = self._wants_images(plan, wave) or (plan.casts_shadows and plan.has_shadow_only)
        if not one_by_one:
            with self._launcher.stage("shade"):
                self._add_unshadowed(scene, plan, wave)
        if plan.casts_shadows or one_by_one:
            self._add_one_by_one(scene, plan, wave, also_unshadowed=one_by_one)

    def images(self, scene: DeviceScene, plan: FramePlan, count: int) -> LightImages:
        """What each light gave the first wave, of ``count`` rays; nothing unless the frame asks for it."""
        if "lights" not in plan.aovs:
            return LightImages()
        numbers = range(len(scene.lights.names))
        get = self._buffers.get
        return LightImages(
            [get(f"light.direct{number}", wp.vec3, count) for number in numbers],
            [get(f"light.arrived{number}", wp.vec3, count) for number in numbers],
        )

    def _wants_images(self, plan: FramePlan, wave: RayWave) -> bool:
        return wave.is_primary and "lights" in plan.aovs

    def _add_unshadowed(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Adds the lights that nothing blocks: without shadows, all of them."""
        no_shadows = not plan.casts_shadows
        lights = [light for light in scene.lights.lights if no_shadows or not light.casts_shadow]
        lamps = sum(not isinstance(light, LightEnvironment) for light in lights) + scene.lights.has_headlight
        soft = self._config.shadows is Shadows.SOFT
        if lamps and not soft:
            self._launcher.run_banded(
                unshadowed_light_kernels.add_hard_lights,
                wave.count,
                *(no_shadows, scene.shading, wave.data),
            )
        if len(lights) > lamps or (soft and lamps):
            self._launcher.run_banded(
                unshadowed_light_kernels.add_sampled_lights,
                wave.count,
                *(no_shadows, scene.shading, wave.data),
            )

    def _add_one_by_one(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, *, also_unshadowed: bool) -> None:
        """Adds the shadowed lights, and the others if they count in images or for what is only darkened."""
        images = self.images(scene, plan, wave.count) if self._wants_images(plan, wave) else None
        arrivals = Arrivals()
        if plan.has_shadow_only:
            arrivals = self._buffers.struct("light.arrivals", Arrivals, wave.count)
            arrivals.sent.zero_()
            arrivals.arrived.zero_()
        for number in range(len(scene.lights.names)):
            light = scene.lights.lights[number] if scene.lights.lights else None
            shadowed = plan.casts_shadows and light is not None and light.casts_shadow
            direct = arrived = None
            if images is not None:
                direct, arrived = images.direct[number], images.arrived[number]
                direct.zero_()
                arrived.zero_()
            if shadowed or also_unshadowed:
                for samples_bsdf in (False, True) if isinstance(light, LightEnvironment) else (False,):
                    contributions, visibility = self._contributions(scene, wave, number, samples_bsdf, shadowed)
                    with self._launcher.stage("shade"):
                        self._launcher.run_banded(
                            kernels.add_light,
                            wave.count,
                            *(shadowed, contributions, visibility, wave.data, arrivals, direct, arrived),
                        )
        if plan.has_shadow_only:
            self._launcher.run_banded(kernels.darken_captured, wave.count, scene.shading, arrivals, wave.data)

    def _contributions(
        self, scene: DeviceScene, wave: RayWave, number: int, samples_bsdf: bool, shadowed: bool
    ) -> tuple[Any, Any]:
        """What a light adds at the interactions if nothing blocks it, and how much of that arrives."""
        contributions = self._buffers.get("light.contributions", wp.vec3, 2 * wave.count)
        shadow_rays = self._buffers.struct("light.shadow_rays", RayData, 2 * wave.count)
        with self._launcher.stage("shade"):
            self._launcher.run_banded(
                kernels.spawn_shadow_rays,
                wave.count,
                *(number, samples_bsdf, scene.shading, wave.data, shadow_rays, contributions),
            )
        if not shadowed:
            return contributions, contributions
        with self._launcher.stage("shadow"):
            skips = wave.row.interactions.shadow_only
            return contributions, self._shadows.trace(scene, shadow_rays, skips, "light.visibility")
