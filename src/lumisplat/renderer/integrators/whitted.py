"""What rays see of what they met, once light and mirrors are followed."""

from __future__ import annotations

from typing import Any

from lumisplat.config import Pipeline, RenderConfig, Shadows
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.integrators import specular_wave_kernels
from lumisplat.renderer.integrators.specular_waves import RayWave, SpecularWaves
from lumisplat.renderer.light import direct_light_kernels, unshadowed_light_kernels
from lumisplat.renderer.light.direct_light import DirectLight, LightImages
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.light_scene import LightScene
from lumisplat.renderer.shadow.shadow_rays import ShadowRays, shadow_modules
from lumisplat.renderer.trace.gaussian_trace import RayTracer
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


class WhittedIntegrator:
    """Colours rays: with lights and shadows if the scene is lit, and with what mirrors and glass bring.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Follows the rays that go on.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._config, self._buffers, self._tracer = config, buffers, tracer
        self.lit = LightScene(launcher, buffers, config)
        """Lights and materials; synchronised before lit frames."""
        self._bounces = SpecularWaves(launcher, buffers, tracer.mesh_hits)
        self._shadows = None if config.shadows is Shadows.OFF else ShadowRays(launcher, buffers, config)
        self._shader = DirectLight(launcher, buffers, config, self.lit, self._shadows)

    def begin_sample(self, sample: int) -> None:
        """Before the rays of a sample."""
        if self._shadows is not None:
            self._shadows.begin_sample(sample)

    def colors(
        self,
        scene: DeviceScene,
        trees: BvhScene | None,
        met: PrimaryHits,
        *,
        lit: bool,
        sample: int,
        reflection: Any = None,
    ) -> Any:
        """RayColors if ``lit``, else display-referred colours, over all that is behind the Gaussians.

        Args:
            scene: After ``sync``, and ``sync_rays`` if there are trees.
            trees: Of the same scene; None: no ray goes on, and nothing blocks lights.
            met: The rays, and what they met.
            lit: With lights.
            sample: Number of the sample.
            reflection: If lit, receives what reflected and refracted rays bring.
        """

        def light(wave: RayWave, number: int, may_branch: bool) -> None:
            direct = reflection if number == 0 else None
            self._shader.shade(scene, trees, wave, number, may_branch=may_branch, reflection=direct)

        if lit:
            self.lit.begin_sample(sample)
        goes_on = trees is not None and self._config.pipeline is not Pipeline.RASTER
        return self._bounces.resolve(
            scene,
            met,
            trace=lambda rays: self._tracer.integrate(trees, rays, "trace.branch_radiance"),  # type: ignore[arg-type]
            bounces=self._config.max_bounces if goes_on else 0,
            light=light if lit else None,
            reflection=reflection,
            darkens=lit and self.lit.has_shadow_only,
        )

    def light_images(self, count: int) -> LightImages | None:
        """What each light gave the rays of pixels last, if the settings ask for it."""
        return self._shader.images(count)


def light_modules(launcher: Launcher, config: RenderConfig) -> list[Any]:
    """The kernel modules that lit frames need besides those of their pipeline."""
    own = [direct_light_kernels, unshadowed_light_kernels, film_kernels, specular_wave_kernels]
    return own if config.shadows is Shadows.OFF else own + shadow_modules(launcher, config)
