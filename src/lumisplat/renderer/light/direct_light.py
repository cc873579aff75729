"""Direct light where rays hit surfaces, with shadow rays to every light that casts shadows.

A wave is all rays after the same number of reflections and refractions.
"""

from __future__ import annotations

import warp as wp

from lumisplat.config import RenderConfig, Shadows
from lumisplat.constants import PACKET_RAYS, SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import CatcherIrradiance
from lumisplat.renderer.light import direct_light_kernels as kernels, unshadowed_light_kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_wave import LightImages, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.lights import LightEnvironment


class DirectLight:
    """Adds direct light to rays at their interactions: up to two points per ray, on Gaussians and on a mesh."""

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._shadows = ShadowRays(launcher, buffers, config)

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules that direct light needs in a frame."""
        modules: list[KernelModule] = []
        if plan.has_unshadowed and not self._launcher.is_parallel:
            modules += [unshadowed_light_kernels.BY_LANES]
        if plan.samples_unshadowed or (plan.has_unshadowed and self._launcher.is_parallel):
            modules += [unshadowed_light_kernels]
        if plan.casts_shadows or "lights" in plan.aovs:
            modules += [kernels]
        if plan.casts_shadows:
            modules += self._shadows.modules(plan.splat_shadows, has_meshes=plan.has_meshes)
        return modules

    def begin_sample(self, sample: int) -> None:
        """Begins sample ``sample`` of the frame; call it before the camera rays of the sample are lit."""
        self._shadows.begin_sample(sample)

    def add(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Adds the direct light of all lights, reflected by the surfaces that rays hit, to the radiance in ``wave``."""
        # Shadow catchers darken by the blocked fraction of all light, so they need unshadowed lights, too.
        one_by_one = self._wants_images(plan, wave) or (plan.casts_shadows and plan.has_shadow_catchers)
        if plan.has_unshadowed and not one_by_one:
            with self._launcher.stage("shade"):
                self._add_unshadowed(scene, plan, wave)
        if plan.casts_shadows or one_by_one:
            self._add_one_by_one(scene, plan, wave, also_unshadowed=one_by_one)

    def images(self, scene: DeviceScene, plan: FramePlan, count: int) -> LightImages:
        """Returns each light's images, without and with shadows, for ``count`` camera rays.

        There are no images unless ``RenderConfig.aovs`` has ``lights``.
        """
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
        """Adds in one pass the lights that cast no shadows; in a frame without shadows, these are all lights."""
        no_shadows = not plan.casts_shadows
        lights = [light for light in scene.lights.lights if no_shadows or not light.casts_shadow]
        analytic = sum(not isinstance(light, LightEnvironment) for light in lights) + scene.lights.has_headlight
        soft = self._config.shadows is Shadows.SOFT
        bands = SHADE_BANDS_PER_THREAD * self._launcher.threads
        if analytic and not soft:
            inputs = no_shadows, scene.shading, wave.data
            if self._launcher.is_parallel:
                self._launcher.run_banded(unshadowed_light_kernels.add_hard_lights, wave.count, *inputs)
            else:
                count = -(-wave.count // PACKET_RAYS)
                self._launcher.run_banded(unshadowed_light_kernels.add_hard_lights_lanes, count, *inputs, bands=bands)
        if len(lights) > analytic or (soft and analytic):
            self._launcher.run_banded(
                unshadowed_light_kernels.add_sampled_lights,
                wave.count,
                *(no_shadows, scene.shading, wave.data),
                bands=bands,
            )

    def _add_one_by_one(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, *, also_unshadowed: bool) -> None:
        """Adds the lights that cast shadows one by one; with ``also_unshadowed``, all other lights, too.

        Lights without shadows are added one by one if images of lights or shadow catchers need them.
        """
        images = self.images(scene, plan, wave.count) if self._wants_images(plan, wave) else None
        arrivals = CatcherIrradiance()
        if plan.has_shadow_catchers:
            arrivals = self._buffers.struct("light.arrivals", CatcherIrradiance, wave.count)
            arrivals.unshadowed.zero_()
            arrivals.shadowed.zero_()
            arrivals.open.zero_()
        for number in range(len(scene.lights.names)):
            light = scene.lights.lights[number] if scene.lights.lights else None
            shadowed = plan.casts_shadows and light is not None and light.casts_shadow
            direct = arrived = catcher_light = None
            if images is not None:
                direct, arrived = images.direct[number], images.arrived[number]
                direct.zero_()
                arrived.zero_()
                if plan.has_shadow_catchers:
                    catcher_light = self._catcher_light(number, wave)
                    catcher_light.zero_()
            if shadowed or also_unshadowed:
                for samples_bsdf in (False, True) if isinstance(light, LightEnvironment) else (False,):
                    contributions = self._contributions(scene, plan, wave, number, samples_bsdf)
                    visibility = self._visibility(scene, plan, wave) if shadowed else contributions
                    with self._launcher.stage("shade"):
                        self._launcher.run_banded(
                            kernels.add_light,
                            wave.count,
                            *(shadowed, contributions, visibility, wave.data, arrivals, direct, arrived, catcher_light),
                        )
        if plan.has_shadow_catchers:
            self._add_ambient(scene, plan, wave, arrivals)
            inputs = plan.ambient_rays, scene.shading, arrivals, wave.data
            self._launcher.run_banded(kernels.darken_captured, wave.count, *inputs)
            pairs = [] if images is None else list(zip(images.direct, images.arrived, strict=True))
            for number, (direct, arrived) in enumerate(pairs):
                inputs = arrivals, self._catcher_light(number, wave), direct, arrived
                self._launcher.run_banded(kernels.add_catcher_light, wave.count, *inputs)

    def _catcher_light(self, number: int, wave: RayWave) -> DeviceArray:
        """Returns a buffer of light ``number``'s irradiance on shadow catchers: N unshadowed, then N shadowed values.

        N is the number of rays of the wave.
        """
        return self._buffers.get(f"light.caught{number}", wp.vec3, 2 * wave.count)

    def _add_ambient(self, scene: DeviceScene, plan: FramePlan, wave: RayWave, arrivals: CatcherIrradiance) -> None:
        """Traces ambient shadow rays from shadow catchers, and adds each ray's unoccluded fraction to ``arrivals``."""
        rays, media = self._shadow_rays(wave), self._media(plan, wave)
        for number in range(plan.ambient_rays):
            inputs = number, scene.shading, wave.data, rays, media
            self._launcher.run_banded(kernels.spawn_ambient_rays, wave.count, *inputs)
            visibility = self._visibility(scene, plan, wave)
            self._launcher.run_banded(kernels.add_ambient_visibility, wave.count, rays, visibility, arrivals)

    def _contributions(
        self, scene: DeviceScene, plan: FramePlan, wave: RayWave, number: int, samples_bsdf: bool
    ) -> DeviceArray:
        """Returns light ``number``'s contributions without shadows, two per ray; also writes their shadow rays."""
        contributions = self._buffers.get("light.contributions", wp.vec3, 2 * wave.count)
        with self._launcher.stage("shade"):
            self._launcher.run_banded(
                kernels.spawn_shadow_rays,
                wave.count,
                *(number, samples_bsdf, scene.shading, wave.data),
                *(self._shadow_rays(wave), self._media(plan, wave), contributions),
                bands=SHADE_BANDS_PER_THREAD * self._launcher.threads,
            )
        return contributions

    def _visibility(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> DeviceArray:
        """Traces the shadow rays, and returns their transmittances: the light's visibilities at the rays' origins."""
        skips = wave.row.interactions.shadow_catcher
        with self._launcher.stage("shadow"):
            return self._shadows.trace(
                scene,
                self._shadow_rays(wave),
                skips,
                "light.visibility",
                media=self._media(plan, wave),
                splat_shadows=plan.splat_shadows,
            )

    def _shadow_rays(self, wave: RayWave) -> RayData:
        return self._buffers.struct("light.shadow_rays", RayData, 2 * wave.count)

    def _media(self, plan: FramePlan, wave: RayWave) -> DeviceArray | None:
        """Returns the buffer for the media around the origins of shadow rays; None if no medium absorbs."""
        return self._buffers.get("light.shadow_media", wp.vec4i, 2 * wave.count) if plan.absorbs else None
