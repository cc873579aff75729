"""Real-time integrator, which lights sequences of frames with global illumination.

The method is in docs/method/realtime.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.render import PATH_PARTS, REALTIME_AOVS
from lumisplat.device.gi.secondary_rays import LobeRays
from lumisplat.device.gi.surfaces import SurfaceLight
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.light.surfaces import Surfaces
from lumisplat.renderer.realtime.antialiasing import Antialiasing
from lumisplat.renderer.realtime.debug_layers import DebugLayers
from lumisplat.renderer.realtime.gbuffer import MESHES, SPLATS, GBuffer, PixelSurfaces
from lumisplat.renderer.realtime.indirect_light import IndirectLight
from lumisplat.renderer.realtime.light_filter import LightFilter
from lumisplat.renderer.realtime.mirrors import Mirrors
from lumisplat.renderer.realtime.pixel_light import PixelLights
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import LightImages, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher

INDIRECT_SHARED = 4
"""Number of pixels that share a sample of indirect light, and therefore its noise: 2 x 2 pixels share a highlight ray.
"""

DIRECT_LOBE_WIDTHS = 0.6
"""Width, in GGX alphas, of the spatial averages of direct light in highlights. From 1 on they spread the highlights of
lamps visibly."""

INDIRECT_LOBE_WIDTHS = 2.0
"""Width, in GGX alphas, of the spatial averages of what highlights reflect: wider, because its rays are noisier."""


@dataclass(frozen=True, slots=True)
class LitSurfaces:
    """The camera rays of a frame with direct light and reflections, before light is averaged over frames."""

    wave: RayWave
    surfaces: list[PixelSurfaces]
    direct: list[SurfaceLight]
    """Samples of direct light on each of ``surfaces``."""
    lobes: tuple[LobeRays, RayData | None] | None
    """Rays within the highlights of surfaces; None: light does not bounce."""
    layers: dict[str, DeviceArray]
    """Layers of light by name, with emission and reflections."""


class RealtimeIntegrator:
    """Computes the radiance of a camera's rays frame after frame, reusing the lighting of earlier frames.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays, and the lighting that is reused from frame to frame.
        config: Settings.
        tracer: Finds the hits of rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        config = replace(config, realtime=config.realtime.of_quality)
        settings = config.realtime.filter
        self._launcher, self._buffers = launcher, buffers
        self._surfaces = Surfaces(launcher, buffers)
        self._shadows = ShadowRays(launcher, buffers, config)
        self._gbuffer = GBuffer(launcher, buffers)
        self._lights = PixelLights(launcher, buffers, config, self._shadows, tracer)
        self._indirect = IndirectLight(launcher, buffers, config, tracer, self._shadows)
        self._mirrors = Mirrors(
            launcher, buffers, config, tracer=tracer, shadows=self._shadows, cache=self._indirect.cache
        )
        self._antialiasing = Antialiasing(launcher, buffers)
        self._debug_layers = DebugLayers(launcher, buffers)
        self._bounces = config.max_bounces != 0
        of_indirect = replace(settings, frames=min(settings.frames, settings.indirect_frames))
        lights = {
            "direct": (settings, 1, DIRECT_LOBE_WIDTHS, False),
            "indirect": (of_indirect, INDIRECT_SHARED, INDIRECT_LOBE_WIDTHS, True),
        }
        self._filters = {
            (name, kind): LightFilter(
                launcher, buffers, given, f"{name}{kind}", shared=shared, lobe_widths=width, is_indirect=is_indirect
            )
            for name, (given, shared, width, is_indirect) in lights.items()
            for kind in (SPLATS, MESHES)
        }
        self._last: tuple[int, tuple[int, int]] | None = None
        """Number and image size of the last frame begun; None: the next frame begins a new sequence."""
        self._layers: dict[str, DeviceArray] = {}
        self._lit: dict[int, LitSurfaces] = {}
        """Result of the last `shade` of an even frame (0) and of an odd one (1)."""
        self.parity = 0
        """Parity of the frame, 0 or 1: even and odd frames store surfaces and their light in different arrays."""

    def modules(self, plan: FramePlan) -> list[KernelModule]:
        """Returns the kernel modules of a frame, without the modules that find primary hits."""
        modules = [*self._indirect.modules(plan), *self._surfaces.modules(), *self._gbuffer.modules()]
        modules += [*self._lights.modules(plan), *LightFilter.modules()]
        modules += self._mirrors.modules(plan) if plan.max_bounces > 0 else []
        modules += self._antialiasing.modules() if plan.jitters else []
        return [*modules, *self._debug_layers.modules()] if plan.aovs & {*REALTIME_AOVS} else modules

    def forget(self) -> None:
        """Drops the lighting of earlier frames: the next frame begins a new sequence."""
        self._last = None

    def begin_sample(self, scene: DeviceScene, sample: int) -> None:
        """Begins frame ``sample`` of the sequence: writes to the device what changes from frame to frame."""
        self.parity = sample % 2
        if self._last != (sample - 1, scene.motion.size_before):  # also after a frame that failed
            self._restart()
        self._last = sample, scene.image_size
        self._shadows.begin_sample(sample)
        if self._lights.begin_frame(scene, sample):
            for kind in (SPLATS, MESHES):
                self._filters["direct", kind].reset()
        self._mirrors.begin_frame(sample)
        if self._bounces:
            self._indirect.begin_frame(scene, sample)

    def graph_key(self, scene: DeviceScene) -> object:
        """Returns values that recorded CUDA graphs contain; a graph recorded with others is stale."""
        boxes = scene.captured_emitters.boxes
        of_scene = scene.motion.graph_key, None if boxes is None else boxes.shape
        histories = [part.has_history for part in (self._indirect.probes, self._antialiasing, *self._filters.values())]
        of_lights = self._lights.graph_key(self.parity)
        return of_scene, of_lights, self._mirrors.graph_key, self._gbuffer.kinds_before, histories

    def shade(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> RayWave:
        """Returns the camera rays with their radiance, as a wave, but without diffuse and indirect light.

        Nothing changes that later frames reuse, so that the frame can be drawn again.

        Args:
            scene: The scene on the device, synced.
            plan: Plan of the frame.
            hits: The rays and their hits.
        """
        self._lit[self.parity] = lit = self._light(scene, plan, hits, self.parity)
        return lit.wave

    def is_complete(self, plan: FramePlan) -> bool:
        """Returns whether all reflected rays of the last `shade` were followed; if not, draw the frame again."""
        return plan.max_bounces == 0 or self._mirrors.finish()

    def finish(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Adds the remaining light to the camera rays, and updates the lighting that later frames reuse."""
        self._layers = self._average(scene, plan, self._lit[self.parity], self.parity)

    def _light(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits, number: int) -> LitSurfaces:
        """Shades the surfaces that camera rays hit, and samples their direct light; follows reflected rays.

        ``number`` is the parity of the frame.
        """
        frame_pass = self._launcher.frame_pass
        with frame_pass("surfaces"):
            wave = self._surfaces.shade(scene, plan, hits, 0, may_branch=plan.max_bounces > 0, on_paths=False)
            layers = self._begin_layers(wave)
            surfaces = self._gbuffer.store(scene, wave, number)
        with frame_pass("direct"):
            of_direct = layers["direct_diffuse"], layers["direct_glossy"]
            direct = self._lights.sample(scene, plan, wave, surfaces, layers=of_direct, parity=number)
        lobes = None
        if self._bounces:
            with frame_pass("indirect"):
                lobes = self._indirect.start_lobes(scene, wave)
        if plan.max_bounces > 0:
            with frame_pass("mirrors"):
                layers["indirect_glossy"].assign(self._mirrors.add(scene, plan, wave))
        if plan.has_shadow_catchers and plan.casts_shadows:
            with frame_pass("direct"):
                self._lights.darken(scene, plan, wave)
        return LitSurfaces(wave, surfaces, direct, lobes, layers)

    def _average(self, scene: DeviceScene, plan: FramePlan, lit: LitSurfaces, number: int) -> dict[str, DeviceArray]:
        """Adds indirect light, and filters all light over frames and pixels; returns the layers of light by name.

        ``number`` is the parity of the frame.
        """
        frame_pass, wave, surfaces, images = self._launcher.frame_pass, lit.wave, lit.surfaces, {**lit.layers}
        light = {"direct": lit.direct}
        if lit.lobes and surfaces:
            with frame_pass("indirect"):
                light["indirect"] = self._indirect.find(scene, plan, surfaces, lit.lobes)
        for name, samples in light.items():
            for kind, noisy in zip(surfaces, samples, strict=True):
                with frame_pass("filters"):
                    filtered = self._filters[name, kind.kind].filter(scene, kind, noisy, number)
                with frame_pass("sum"):
                    layers = images[f"{name}_diffuse"], images[f"{name}_glossy"]
                    self._lights.add(scene, wave, kind, filtered, layers)
        if plan.jitters:
            with frame_pass("antialiasing"):
                sizes = (scene.motion.size_before, number + 1), (scene.image_size, number)
                before, now = (self._lights.known(*size) for size in sizes)
                self._antialiasing.average(scene, plan, wave, images, known=(before, now), frame=number)
        if debug_names := sorted(plan.aovs & {*REALTIME_AOVS}):
            with frame_pass("views"):
                images |= self._debug_images(debug_names, scene, surfaces, wave.count, number)
        return images

    def light_images(self, scene: DeviceScene, plan: FramePlan, hits: PrimaryHits) -> LightImages:
        """Returns the layers of light that the frame requests, from the last `shade`."""
        return LightImages(layers={name: image for name, image in self._layers.items() if name in plan.aovs})

    def _restart(self) -> None:
        """Drops all lighting of earlier frames."""
        parts = self._gbuffer, self._lights, self._indirect.cache, self._indirect.probes, self._antialiasing
        for part in (*parts, *self._filters.values()):
            part.reset()

    def _debug_images(
        self, names: list[str], scene: DeviceScene, surfaces: list[PixelSurfaces], count: int, frame: int
    ) -> dict[str, DeviceArray]:
        """Draws the debug layers whose names are in ``names``, and returns them by name."""
        debug, images, indirect = self._debug_layers, dict[str, DeviceArray](), self._indirect
        for name in names:
            if name == "motion":
                images[name] = debug.motion(scene, surfaces, count)
            elif name == "history":
                frames = {kind.kind: self._filters["direct", kind.kind].frames(scene, frame) for kind in surfaces}
                images[name] = debug.history(scene, surfaces, frames, count)
            elif not self._bounces or not surfaces:
                images[name] = debug.empty(name, count)
            elif name == "probes":
                images[name] = debug.probes(scene, indirect.probes, count)
            elif name == "cache":
                images[name] = debug.cache(scene, indirect.cache, surfaces, count)
            else:
                images[name] = debug.cache_cells(scene, indirect.cache, surfaces, count)
        return images

    def _begin_layers(self, wave: RayWave) -> dict[str, DeviceArray]:
        """Returns black layers of light by name; the emission layer starts with the emission of surfaces."""
        layers = {name: self._buffers.get(f"realtime.{name}", wp.vec3, wave.count) for name in PATH_PARTS}
        for image in layers.values():
            image.zero_()
        layers["emission"].assign(wave.row.radiance.light)
        return layers
