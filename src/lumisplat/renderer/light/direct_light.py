"""Host pass: light where rays end, with shadow rays to every light that something may block."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from lumisplat.config import RenderConfig, Shadows
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Arrivals
from lumisplat.renderer.light import direct_light_kernels as kernels
from lumisplat.renderer.light import unshadowed_light_kernels
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.light_scene import LightScene
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import LightEnvironment


@dataclass(frozen=True, slots=True)
class LightImages:
    """What each light gives the rays from the camera, one array a light."""

    direct: list[Any]
    """If nothing were in the way, linear."""
    arrived: list[Any]


class DirectLight:
    """Lights what rays meet.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        lit: The lit scene.
        shadows: Follows rays to the lights; None where nothing blocks them.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, config: RenderConfig, lit: LightScene, shadows: ShadowRays | None
    ) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._lit, self._shadows = lit, shadows

    def shade(
        self,
        scene: DeviceScene,
        trees: BvhScene | None,
        wave: RayWave,
        number: int,
        *,
        may_branch: bool,
        reflection: Any = None,
    ) -> None:
        """Writes what the rays of a wave see, but for what mirrors and glass bring, and which rays go on.

        Args:
            scene: What there is.
            trees: Its Gaussians as shadow rays meet them; None where nothing blocks lights.
            wave: Rays, a multiple of a packet's.
            number: Of the wave; 0: the rays of pixels.
            may_branch: Rays may go on.
            reflection: Receives what pixels' rays that may not go on would bring, linear; None: not asked for.
        """
        from_camera = number == 0
        images = self.images(wave.count) if from_camera else None
        blocks = trees is not None and self._config.shadows is not Shadows.OFF
        met = wave.met.rays, wave.met.hits, wave.met.radiance
        with self._launcher.stage("shade"):
            self._launcher.run_banded(
                kernels.start_shading,
                wave.count,
                *(from_camera, may_branch, self._lit.data, *met, wave.path_weights, wave.colors, wave.branches),
                self._buffers.get("shade.nothing", wp.vec3, 0) if reflection is None else reflection,
            )
            # A shadow is a share of all light: where sets are only darkened, lights that nothing blocks count, too.
            alone = images is not None or (blocks and self._lit.has_shadow_only)
            for kernel in () if alone else self._unblocked(blocks):
                self._launcher.run_banded(
                    kernel, wave.count, from_camera, not blocks, self._lit.data, *met, wave.colors.light
                )
        if blocks or images is not None:
            self._add_lights(scene, trees, wave, from_camera=from_camera, images=images)

    def _unblocked(self, blocks: bool) -> list[Any]:
        """The kernels that add the lights that nothing blocks; where nothing ``blocks`` any, all of them."""
        lights = [light for light in self._lit.lights if not (blocks and light.casts_shadow)]
        lamps = sum(not isinstance(light, LightEnvironment) for light in lights) + self._lit.has_headlight
        soft = self._config.shadows is Shadows.SOFT
        sampled = len(lights) > lamps or (soft and lamps)
        needed = [unshadowed_light_kernels.add_hard_lights] if lamps and not soft else []
        return [*needed, unshadowed_light_kernels.add_sampled_lights] if sampled else needed

    def images(self, count: int) -> LightImages | None:
        """What the lights gave the rays of pixels last, if the settings ask for it."""
        if "lights" not in self._config.aovs:
            return None
        numbers = range(len(self._lit.light_names))
        get = self._buffers.get
        return LightImages(
            [get(f"shade.direct{number}", wp.vec3, count) for number in numbers],
            [get(f"shade.arrived{number}", wp.vec3, count) for number in numbers],
        )

    def _add_lights(
        self,
        scene: DeviceScene,
        trees: BvhScene | None,
        wave: RayWave,
        *,
        from_camera: bool,
        images: LightImages | None,
    ) -> None:
        count = wave.count
        get, run, stage = self._buffers.get, self._launcher.run_banded, self._launcher.stage
        shadow_rays = self._buffers.struct("shade.rays", RayData, 2 * count)
        skips = get("shade.skips", wp.int32, 2 * count)
        contributions = get("shade.contributions", wp.vec3, 2 * count)
        arrivals = self._buffers.struct("shade.arrivals", Arrivals, count if self._lit.has_shadow_only else 0)
        if self._lit.has_shadow_only:
            arrivals.sent.zero_()
            arrivals.arrived.zero_()
        nothing = get("shade.nothing", wp.vec3, 0)
        data = self._lit.data
        for number in range(len(self._lit.light_names)):
            light = self._lit.lights[number] if self._lit.lights else None
            casts = light is not None and light.casts_shadow
            blocked = casts and self._shadows is not None and trees is not None
            if images is not None:
                images.direct[number].zero_()
                images.arrived[number].zero_()
            elif not casts and not self._lit.has_shadow_only:
                continue  # added already
            for picks_bsdf in (False, True) if isinstance(light, LightEnvironment) else (False,):
                with stage("shade"):
                    run(
                        kernels.spawn_shadow_rays,
                        count,
                        *(number, picks_bsdf, from_camera, data, wave.met.rays, wave.met.hits, wave.met.radiance),
                        *(shadow_rays, skips, contributions),
                    )
                visibility = contributions
                if blocked:
                    assert self._shadows is not None and trees is not None
                    with stage("shadow"):
                        visibility = self._shadows.trace(scene, trees, shadow_rays, skips, "shade.shadows")
                with stage("shade"):
                    run(
                        kernels.add_light,
                        count,
                        *(blocked, contributions, visibility, skips, arrivals, wave.colors.light),
                        *((nothing, nothing) if images is None else (images.direct[number], images.arrived[number])),
                    )
        if self._lit.has_shadow_only:
            run(
                kernels.darken_captured,
                count,
                *(from_camera, data, wave.met.rays, wave.met.hits, wave.met.radiance, arrivals, wave.colors.kept),
            )
