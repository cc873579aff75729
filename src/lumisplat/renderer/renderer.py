"""From a scene and a camera to a frame, as a list of passes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy.typing as npt
import warp as wp

from lumisplat.config import Pipeline, RasterStrategy, RenderConfig, Shadows
from lumisplat.device.structs.rays import RayData
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame, FrameStats
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.checks import check_camera, check_resumable, check_scene, checked_config
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.film import Film
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.integrators import specular_wave_kernels
from lumisplat.renderer.integrators.whitted import WhittedIntegrator, light_modules
from lumisplat.renderer.raster import binning_kernels, mesh_raster_kernels, splat_raster_kernels
from lumisplat.renderer.raster.binning import BinningChunked, BinningCounts, BinningParallel
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.raster_hits import RasterPrimary
from lumisplat.renderer.raster.splat_raster import SplatRaster, refuse_lens
from lumisplat.renderer.ray_queries import RayHits, RayQueries, checked_distances, checked_rays
from lumisplat.renderer.scene import gaussian_bvh_kernels
from lumisplat.renderer.scene.bvh_scene import BvhScene
from lumisplat.renderer.scene.camera_table import subpixel
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.renderer.trace.gaussian_trace import RayTracer, ray_count, trace_modules, transmit_modules
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher, Progress
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


class Renderer:
    """Keeps assets, buffers and compiled kernels warm between frames. Not safe to share between threads.

    Args:
        config: Settings; the defaults draw a capture as it was trained.
        launcher: The device to run on.
        progress: As for ``create_renderer``.
    """

    def __init__(self, config: RenderConfig, launcher: Launcher, progress: Progress | None = None) -> None:
        self.config = config
        self._launcher = launcher
        self._buffers = Buffers(launcher.device)
        self._scene = DeviceScene(launcher.device)
        self._trees = BvhScene(launcher)
        self._tracer = RayTracer(launcher, self._buffers, config)
        self._transport = WhittedIntegrator(launcher, self._buffers, config, self._tracer)
        self._film = Film(launcher, self._buffers, config)
        self._queries = RayQueries(launcher, self._buffers, self._tracer, self._transport, config)
        self._order = (BinningParallel if launcher.is_parallel else BinningChunked)(launcher, self._buffers)
        self._meshes = MeshRaster(launcher, self._buffers, self._order)
        self._splats = SplatRaster(launcher, self._buffers, self._order)
        self._primary = RasterPrimary(
            launcher, self._buffers, config, order=self._order, meshes=self._meshes, splats=self._splats
        )
        self._loaded: set[int] = set()
        self._load(self._pipeline_modules(), progress)
        if config.lighting:
            self._load(self._light_modules(), progress)

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def render(
        self, scene: Scene, camera: Camera, *, resume: Frame | None = None, progress: Progress | None = None
    ) -> Frame:
        """Renders one frame.

        Args:
            scene: What to draw. Assets already seen by this renderer are not uploaded again; where one of as many
                Gaussians takes the place of another, the ray tracer follows it as if it had moved.
            camera: From where.
            resume: A ray-traced frame of the same scene, view and settings: ``config.samples`` more are added to its
                mean, as if all had been rendered at once.
            progress: Called with a label and the fraction of the samples done, 0..1.

        Raises:
            ConfigError: ``resume`` is no frame, has another camera or other settings, is not ray traced, or has too
                many samples.
            DeviceError: The device is out of memory.
            SceneError: The scene or the camera is none, it or the image is larger than 32-bit indices reach, or the
                rasteriser is to draw a camera that is not a pinhole.
        """
        check_scene(scene)
        check_camera(camera)
        lit = is_lit(self.config, scene)
        first = 0 if resume is None else self._resumed(resume, scene, camera, lit)
        self._launcher.stage_ms = {}
        if self.config.pipeline is not Pipeline.TRACE:
            refuse_lens(camera)
            self._splats.warn_of_degree(scene)
        if lit:
            self._load(self._light_modules(), progress)
            if self.config.pipeline is Pipeline.RASTER:
                self._splats.warn_of_mirrors(scene)
        if self._samples(lit):
            return self._sampled(scene, camera, lit, first, progress)
        return self._raster(scene, camera)

    def trace_rays(self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike) -> RayHits:
        """As the function ``trace_rays``; of a renderer with ``Pipeline.TRACE``, which keeps the scene's trees."""
        start, along = checked_rays(origins, directions)
        lit = self._sync_rays(scene)
        return self._queries.look(self._scene, self._trees, start, along, lit=lit)

    def transmittance(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, max_distance: npt.ArrayLike = math.inf
    ) -> FloatArray:
        """As the function ``transmittance``; of a renderer with ``Pipeline.TRACE``, which keeps the scene's trees."""
        start, along = checked_rays(origins, directions)
        distances = checked_distances(max_distance, len(start))
        self._sync_rays(scene)
        self._load(transmit_modules(self._launcher))
        return self._queries.transmit(self._scene, self._trees, start, along, distances)

    def _sync_rays(self, scene: Scene) -> bool:
        """Brings the device up to date for rays; whether they are lit."""
        if self.config.pipeline is not Pipeline.TRACE:
            raise ConfigError("rays are traced by a renderer with Pipeline.TRACE: this one rasterises")
        check_scene(scene)
        lit = is_lit(self.config, scene)
        if lit:
            self._load(self._light_modules())
        self._launcher.stage_ms = {}
        self._sync(scene, Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), lit, for_camera=False)
        return lit

    def _sync(self, scene: Scene, camera: Camera, lit: bool, *, for_camera: bool = True) -> BvhScene | None:
        """Brings the device up to date; the trees, if any ray is traced."""
        with self._launcher.stage("sync"):
            self._scene.sync(scene, camera, self.config, lit=lit)
            trees = self._trees if self._traces(scene, lit) else None
            if trees or lit or self._samples(lit):
                self._scene.sync_rays(scene)
            if lit:
                self._transport.lit.sync(scene, self._scene, camera, for_camera=for_camera)
        if trees:
            with self._launcher.stage("build"):
                trees.sync(scene, self._scene, self.config, lit=lit)
        return trees

    def _traces(self, scene: Scene, lit: bool) -> bool:
        """Whether a frame follows rays: from the camera, from mesh to mesh, or to lights."""
        if self.config.pipeline is not Pipeline.RASTER:
            return True
        casts = any(light.enabled and light.casts_shadow for light in scene.lights)
        return lit and casts and self.config.shadows is not Shadows.OFF

    def _samples(self, lit: bool) -> bool:
        """Whether a frame is the mean of samples: all are but the unlit, sorted raster that counts nothing."""
        special = self.config.raster.strategy is RasterStrategy.STOCHASTIC or "hits" in self.config.aovs
        return lit or special or self.config.pipeline is not Pipeline.RASTER

    def _pipeline_modules(self) -> list[Any]:
        modules: list[Any] = []
        if self.config.pipeline is not Pipeline.RASTER:
            modules += trace_modules(self._launcher, self.config)
        if self.config.pipeline is not Pipeline.TRACE:
            modules += [splat_raster_kernels, binning_kernels, mesh_raster_kernels]
        if self._samples(lit=False):
            modules += [camera_ray_kernels, specular_wave_kernels]
        if "hits" in self.config.aovs:
            modules += [film_kernels]
        return modules

    def _light_modules(self) -> list[Any]:
        shadowed = self.config.shadows is not Shadows.OFF
        return [
            camera_ray_kernels,
            *([gaussian_bvh_kernels] if shadowed else []),
            *light_modules(self._launcher, self.config),
        ]

    def _load(self, modules: list[Any], progress: Progress | None = None) -> None:
        missing = [module for module in modules if id(module) not in self._loaded]
        if missing:
            self._launcher.load(missing, progress)
            self._loaded |= {id(module) for module in missing}

    def _raster(self, scene: Scene, camera: Camera) -> Frame:
        self._sync(scene, camera, False)
        self._draw(camera)
        while not self._order.finish():
            self._draw(camera)
        with self._launcher.stage("download"):
            return self._frame(scene, camera, self._order.counts, samples=0, lit=False)

    def _sampled(self, scene: Scene, camera: Camera, lit: bool, first: int, progress: Progress | None) -> Frame:
        trees = self._sync(scene, camera, lit)
        self._film.begin(camera)
        count = self.config.samples
        for sample in range(first, first + count):
            self._add_sample(camera, trees, sample, lit=lit, last=sample == first + count - 1)
            if progress:
                progress("tracing", (sample - first + 1) / count)
        with self._launcher.stage("download"):
            counts = BinningCounts(visible=0, nonfinite=0, pairs=0)
            if self.config.pipeline is not Pipeline.TRACE:
                counts = self._order.counts
            counts = replace(counts, nonfinite=counts.nonfinite + self._film.nonfinite_count(camera))
            return self._frame(scene, camera, counts, samples=first + count, lit=lit)

    def _add_sample(self, camera: Camera, trees: BvhScene | None, sample: int, *, lit: bool, last: bool) -> None:
        """One ray a pixel: what it meets, what it sees there, and onto the film."""
        film = self._film
        film.begin_sample(camera, sample)
        self._transport.begin_sample(sample)
        met = self._met(camera, trees, sample)
        reflection = None
        if lit and "reflection" in self.config.aovs:
            reflection = self._buffers.get("film.ray.reflection", wp.vec3, met.count)
        with self._launcher.stage("light" if lit else "bounce"):
            colors = self._transport.colors(self._scene, trees, met, lit=lit, sample=sample, reflection=reflection)
        if lit:
            lights = self._transport.light_images(met.count)
            film.add_lit(self._transport.lit, camera, met, colors, last=last, lights=lights, reflection=reflection)
        else:
            film.add(self._scene, camera, met, colors)

    def _met(self, camera: Camera, trees: BvhScene | None, sample: int) -> PrimaryHits:
        """The rays of a sample, the meshes that they meet, and what the Gaussians before those give them."""
        if self.config.pipeline is not Pipeline.TRACE:
            self._scene.place_sample(camera, self.config, subpixel(sample if self.config.trace.jitter else 0))
            return self._primary.look(self._scene, camera, self._film.lens)
        assert trees is not None
        with self._launcher.stage("rays"):
            rays = self._buffers.struct("trace.rays", RayData, ray_count(camera))
            self._launcher.run_banded(camera_ray_kernels.start_rays, rays.t_max.shape[0], self._film.lens, rays)
        return self._tracer.look(self._scene, trees, rays)

    def _resumed(self, frame: Frame, scene: Scene, camera: Camera, lit: bool) -> int:
        """Puts a frame back into the surface buffers; the number of the next sample."""
        check_resumable(frame, camera, self.config, lit=lit, samples=self._samples(lit))
        if lit and any(instance.shadow_only for instance in scene.splats):
            raise ConfigError("cannot resume a lit frame with shadow-only sets: how much is left of them is not kept")
        images: dict[str, Any] = {
            "color": frame.color if frame.captured is None else frame.captured,
            "alpha": frame.alpha,
            "depth": frame.depth,
            "normal": frame.normal,
            "gaussian": frame.gaussian_index,
            "instance": frame.instance_index,
        }
        if frame.light is not None:
            images |= {"captured_weight": frame.captured_weight, "light": frame.light, "linear": frame.color}
        self._film.resume(camera, images)
        return frame.samples

    def _draw(self, camera: Camera) -> None:
        key = (camera.width, camera.height, self._scene.version, self._buffers.allocations, self._order.growth)
        self._launcher.replay("frame", key, lambda: self._passes(camera))

    def _passes(self, camera: Camera) -> None:
        stage = self._launcher.stage
        self._order.begin()
        with stage("mesh"):
            hits = self._meshes.draw(self._scene, camera)
        with stage("project"):
            splats, keys, rects = self._splats.project(self._scene)
        with stage("sort"):
            depth_order = self._order.sort(keys)
        with stage("bin"):
            lists = self._splats.bin(depth_order, rects, camera)
        with stage("composite"):
            self._splats.composite(self._scene, camera, splats, lists, hits)

    def _frame(self, scene: Scene, camera: Camera, counts: BinningCounts, samples: int, lit: bool) -> Frame:
        developed = self._film.developed(camera) if lit else {}
        images = PixelBuffers.of(self._buffers, camera).download()
        light: dict[str, Any] = {} if samples == 0 else self._film.images(camera, 0, lit=False)
        if lit:
            names = self._transport.lit.light_names
            light = {"captured": images["color"], "captured_weight": developed["captured_weight"]}
            light |= {"light": developed["light"], "color_space": "linear"}
            light |= self._film.images(camera, len(names), lit=True)
            light["light_names"] = names if "lights" in self.config.aovs else ()
        return Frame(
            color=developed["color"] if lit else images["color"],
            alpha=images["alpha"],
            depth=images["depth"],
            normal=images["normal"],
            gaussian_index=images["gaussian"],
            instance_index=images["instance"],
            camera=camera,
            background=self.config.background,
            samples=samples,
            config=self.config,
            stats=FrameStats(
                stage_ms=self._launcher.stage_ms,
                gaussian_count=scene.gaussian_count,
                visible_count=counts.visible,
                nonfinite_count=counts.nonfinite,
                pair_count=counts.pairs,
                triangle_count=scene.face_count,
                memory_bytes=self._scene.bytes + self._buffers.bytes + self._trees.bytes,
            ),
            **light,
        )


def is_lit(config: RenderConfig, scene: Scene) -> bool:
    """Whether lights light a scene: as the settings say, or if it has any."""
    return bool(scene.lights) if config.lighting is None else config.lighting


def create_renderer(
    config: RenderConfig | None = None,
    device: str = "auto",
    *,
    threads: int | None = None,
    profile: bool = False,
    progress: Progress | None = None,
) -> Renderer:
    """A renderer whose kernels are compiled and loaded.

    Args:
        config: Settings; None: the defaults.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.
        threads: CPU threads; None: as many as this process may use.
        profile: Time every stage on CUDA too.
        progress: Called with a label and a fraction 0..1 while kernels compile, which takes seconds once a machine.

    Raises:
        ConfigError: ``threads`` is not positive, or ``config`` is no RenderConfig.
        DeviceError: There is no such device.
    """
    return Renderer(checked_config(config), Launcher(device, threads, profile), progress)
