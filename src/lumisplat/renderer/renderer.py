"""From a scene and a camera to a frame, as a list of passes."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.config import Projection, RasterStrategy, RenderConfig
from lumisplat.config.pipelines import Integrator
from lumisplat.device.structs.camera import ListedRays
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame
from lumisplat.frame.frame_data import FrameStats
from lumisplat.frame.redistorted import pinhole_of, redistorted
from lumisplat.frame.sample_part import SamplePart
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.progress import Progress
from lumisplat.renderer.captured_light import CapturedLightCache, uses_captured_light
from lumisplat.renderer.catcher_meshes import (
    catcher_config,
    catcher_scenes,
    has_catcher_meshes,
    with_caught_shadows,
    with_scene_indices,
    without_catcher_meshes,
)
from lumisplat.renderer.checks import (
    RasterWarnings,
    check_aovs,
    check_blocks,
    check_projection,
    check_resumable,
    check_resumed_scene,
    check_samples,
    check_sampling,
    check_scene,
    check_window,
    checked_config,
)
from lumisplat.renderer.film.film import Film
from lumisplat.renderer.integrators.integrators import Integrators
from lumisplat.renderer.light.light_warnings import LightWarnings
from lumisplat.renderer.raster.binning import BinningCounts, binning_of
from lumisplat.renderer.raster.mesh_raster import MeshRaster
from lumisplat.renderer.raster.raster_hits import RasterHits
from lumisplat.renderer.raster.splat_raster import SplatRaster
from lumisplat.renderer.raster.unlit_raster import UnlitRaster
from lumisplat.renderer.raster.unscented_raster import UnscentedRaster
from lumisplat.renderer.rays import PixelProfile, RayHits, RayProfiles, RayQueries, checked_distances, checked_rays
from lumisplat.renderer.sample_budget import SampleBudget
from lumisplat.renderer.scene.camera_table import check_camera, refuse_lens
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import CapturedLight, FramePlan
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import focused_camera, pixel_ray
from lumisplat.scene.scene import Scene

_ANY_CAMERA = Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""Of rays that are not a camera's."""


class Renderer:
    """Keeps assets, buffers and compiled kernels warm between frames. Not safe to share between threads.

    Args:
        config: Settings; the defaults draw a capture as it was trained.
        launcher: The device to run on.
        progress: As for ``create_renderer``.
        compiles: Likewise.
        buffers: Hold its arrays; None: new ones.
    """

    def __init__(
        self,
        config: RenderConfig,
        launcher: Launcher,
        progress: Progress | None = None,
        *,
        compiles: bool = True,
        buffers: Buffers | None = None,
    ) -> None:
        check_sampling(config)
        self.config = config
        self._launcher, self._progress = launcher, progress
        self._buffers = buffers = buffers or Buffers(launcher.device)
        self._scene = DeviceScene(launcher, buffers, config)
        self._binning = binning = binning_of(launcher, buffers)
        meshes = MeshRaster(launcher, buffers, binning)
        splats = SplatRaster(launcher, buffers, config, binning)
        self._unlit_raster = UnlitRaster(launcher, buffers, binning=binning, meshes=meshes, splats=splats)
        self._raster = RasterHits(launcher, buffers, config, binning=binning, meshes=meshes, splats=splats)
        self._unscented = UnscentedRaster(launcher, buffers, config, binning)
        self._camera_rays = CameraRays(launcher, buffers)
        self._tracer = RayTracer(launcher, buffers, config)
        self._integrators = Integrators(launcher, buffers, config, self._tracer)
        self._film = Film(launcher, buffers)
        self._queries = RayQueries(launcher, buffers, config, self._tracer, self._integrators)
        self._profiles = RayProfiles(launcher, buffers, config)
        self._warnings = RasterWarnings()
        self._light_warnings = LightWarnings()
        self._captured_light = CapturedLightCache()
        self._developed: FrameStats | None = None
        """Of the last frame, as long as the film has its samples."""
        self._loaded: tuple[FramePlan, bool] | None = None
        """Plan of the last frame, and whether it was encoded."""
        self._frame_number = 0
        """Of the next frame, where each adds to what those before it have found."""
        self._catchers: Renderer | None = None
        """Finds what meshes that are shadow catchers catch."""
        if compiles:
            self._load(self._modules(FramePlan.of(config, Scene())))

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def prepare(self, scene: Scene, *, encode: bool = False, progress: Progress | None = None) -> None:
        """Compiles and loads the kernels that frames of a scene need, so that its first frame compiles nothing.

        Args:
            scene: What will be drawn; nothing of it is uploaded.
            encode: As of `render`.
            progress: Called with a label and the fraction done, 0..1.

        Raises:
            ConfigError: Such frames are refused, whatever the camera.
            SceneError: The scene is none.
        """
        check_scene(scene)
        modules: list[KernelModule] = []
        if has_catcher_meshes(scene):
            for caught in catcher_scenes(scene):
                modules += self._catcher_renderer()._modules_of(caught)
            scene = without_catcher_meshes(scene)
        plan = FramePlan.of(self.config, scene)
        check_aovs(self.config, plan)
        if plan.rasterises:
            check_projection(self.config)
        self._load([*modules, *self._modules_of(scene, encode=encode)], progress)

    def _modules_of(self, scene: Scene, *, encode: bool = False) -> list[KernelModule]:
        """The kernel modules of frames of a scene; those that take long to compile first."""
        modules: list[KernelModule] = []
        if uses_captured_light(self.config, scene):  # or a headlight, if captures do not surround its meshes
            light = CapturedLight(visible=False, casts_shadow=False)
            modules += self._modules(FramePlan.of(self.config, replace(scene, lights=(light,))), encodes=encode)
            modules += self._unlit_raster.modules(has_meshes=False)
        return [*modules, *self._modules(FramePlan.of(self.config, scene), encodes=encode)]

    def _modules(self, plan: FramePlan, *, bounced: bool = False, encodes: bool = False) -> list[KernelModule]:
        """The kernel modules of frames of a plan, or of given rays, which surfaces have scattered if ``bounced``."""
        others = [*self._scene.modules(plan), *self._film.modules(plan, encodes=encodes)]
        if not plan.is_sampled:
            return [*self._unlit_raster.modules(has_meshes=plan.has_meshes), *others]
        if plan.is_unscented:
            hits = self._unscented.modules(plan)
        elif plan.rasterises:
            hits = self._raster.modules(plan)
        else:
            hits = self._tracer.modules(plan, bounced=bounced)
        return [*hits, *self._integrators.of(plan).modules(plan), *self._camera_rays.modules(), *others]

    def render(
        self,
        scene: Scene,
        camera: Camera,
        *,
        resume: Frame | None = None,
        encode: bool = False,
        progress: Progress | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> Frame:
        """Renders one frame.

        Args:
            scene: What to draw. Assets of the last frame are not uploaded again. If a capture replaces another one with
                as many Gaussians, the ray tracer refits the hierarchy instead of building a new one.
            camera: From where. A frame of ``Pipeline.REALTIME`` is the next one of a sequence: it keeps what earlier
                ones have found of the light, whatever has moved since; ``reset`` forgets it.
            resume: A frame of samples of the same scene, view and settings, but for ``samples`` and ``time_limit``:
                more are added to it, as if all had been rendered at once.
            encode: Whether the device tone-maps the picture and encodes its bytes, so that ``numpy.asarray(frame,
                numpy.uint8)`` and saving a PNG need not; CUDA always does.
            progress: Called after each sample with a label and the fraction done, 0..1. The label has the number of
                samples and, once they are enough to tell, their noise, after commas.
            stop: Asked often while samples are made on a CPU, by any thread; once it says True, the frame is given up,
                and the renderer is as before. Frames in real time follow from each other, and are always finished.

        Raises:
            StoppedError: ``stop`` said so.
            ConfigError: ``resume`` is no frame, has another camera, other settings or another number of Gaussians or
                triangles, is not ray traced, or has too many samples.
            DeviceError: The device is out of memory.
            SceneError: The scene or the camera is none, it or the image is larger than 32-bit indices reach, or the
                rasteriser is to draw a camera that is not a pinhole, or whose lens distorts too much.
        """
        check_scene(scene)
        check_camera(camera)
        if has_catcher_meshes(scene):
            if resume is not None:
                raise ConfigError("a frame with meshes that are shadow catchers cannot be resumed")
            return self._with_caught_shadows(scene, camera, progress, stop)
        scene = self._with_captured_light(scene)
        plan = FramePlan.of(self.config, scene)
        if plan.rasterises and not plan.is_unscented and camera.is_distorted:
            refuse_lens(camera, self.config.pipeline)
            if resume is not None:
                raise ConfigError("a rasterised frame of a distorting lens cannot be resumed: it is resampled")
            pinhole = self.render(scene, pinhole_of(camera), progress=progress)
            self._developed = None
            return redistorted(pinhole, camera)
        self._check(plan, scene, camera, resume)
        self._begin(plan, scene, camera, progress, encodes=encode)
        if not plan.is_sampled:
            pixels = self._unlit_raster.draw(self._scene)
            with self._launcher.stage("download"):
                transparent = self.config.background is None
                images = self._film.unlit_images(pixels, transparent=transparent, encodes=encode)
                return self._frame(scene, camera, images, self._binning.counts, samples=0)

        with self._launcher.stoppable(None if plan.has_history else stop):
            counts, budget = self._sampled(plan, camera.exposure, resume, progress)
        images = self._images(plan, camera, encodes=encode)
        self._light_warnings.warn_of_media(plan, scene, self._buffers)
        frame = self._frame(scene, camera, images, counts, samples=budget.done, noise=budget.noise)
        self._developed = frame.stats
        return frame

    def _with_caught_shadows(
        self, scene: Scene, camera: Camera, progress: Progress | None, stop: Callable[[], bool] | None
    ) -> Frame:
        """A frame of a scene whose meshes catch shadows, which frames of another renderer find."""
        shown, returns_ratio = without_catcher_meshes(scene), "shadow_ratio" in self.config.aovs
        frame = self.render(shown, camera, progress=progress, stop=stop)
        self._developed = None
        if not frame.has("light"):
            return with_scene_indices(frame, scene)
        catchers = self._catcher_renderer()
        caught = with_caught_shadows(
            frame, scene, lambda one: catchers.render(one, camera, stop=stop), returns_ratio=returns_ratio
        )
        return with_scene_indices(caught, scene)

    def _catcher_renderer(self) -> Renderer:
        """Finds what meshes that are shadow catchers catch."""
        if self._catchers is None:
            self._catchers = Renderer(catcher_config(self.config), self._launcher, compiles=False)
        return self._catchers

    def render_part(self, scene: Scene, camera: Camera, part: SamplePart, *, progress: Progress | None = None) -> Frame:
        """A frame of a part of all samples: of those that it holds, else they are drawn. See ``render_samples``."""
        check_scene(scene)
        check_camera(camera)
        if has_catcher_meshes(scene):
            raise ConfigError("samples of a frame with meshes that are shadow catchers cannot be split")
        scene = self._with_captured_light(scene)
        plan = FramePlan.of(self.config, scene)
        check_blocks(self.config, plan, camera)
        self._check(plan, scene, camera, None)
        self._begin(plan, scene, camera, progress)
        counts = BinningCounts()
        if part.accumulated:
            self._film.begin(self._scene, plan, part=part)
            self._film.finish(self._scene)
        else:
            plan = replace(plan, samples=part.count)
            counts, _ = self._sampled(plan, camera.exposure, None, progress, part)
        images = self._images(plan, camera)
        counts = replace(counts, nonfinite=self._film.nonfinite_count)
        return self._frame(scene, camera, images, counts, samples=part.count)

    def reconfigure(self, config: RenderConfig) -> None:
        """Changes the settings: the next frames are those of a new renderer, to the bit.

        The assets and their hierarchies stay on the device, which a new renderer would upload and build again. A
        sequence of ``Pipeline.REALTIME`` starts anew, as after ``reset``, and buffers of another pipeline are freed. If
        nothing but ``tone_map`` changes, sequences and samples stay as they are: `develop` shows frames with it.

        Args:
            config: The new settings.

        Raises:
            ConfigError: ``config`` is no RenderConfig, or no frame can have it; the renderer is as before.
            DeviceError: The device is out of memory; the renderer is as before.
        """
        before, config = self.config, checked_config(config)
        if replace(config, tone_map=before.tone_map) == before:
            self.config = config
            return
        has_same_buffers = config.pipeline is before.pipeline and not config.pipeline.is_sequence
        buffers = self._buffers if has_same_buffers else None
        other = Renderer(config, self._launcher, self._progress, compiles=False, buffers=buffers)
        other._scene.take_assets(self._scene)
        other._warnings, other._light_warnings = self._warnings, self._light_warnings  # each warns once
        self._launcher.drop_graphs()
        vars(self).update(vars(other))

    def develop(self, frame: Frame, exposure: float | None = None, *, encode: bool = False) -> Frame:
        """Returns a frame of this renderer with its present tone map, and another exposure, without new samples.

        Args:
            frame: The frame; of the last one, the device has all that it takes.
            exposure: Stops; None: as it is.
            encode: As of `render`.
        """
        camera = frame.camera if exposure is None else replace(frame.camera, exposure=exposure)
        config = None if frame.config is None else replace(frame.config, tone_map=self.config.tone_map)
        is_on_film = self._developed is not None and frame.stats is self._developed and not frame.is_denoised
        encodes = is_on_film and (encode or self._buffers.downloads.is_lazy)
        return frame.developed(camera, config, self._film.picture(camera.exposure, self.config) if encodes else None)

    def reset(self) -> None:
        """Forgets what frames of ``Pipeline.REALTIME`` have found: the next one is as the first of a new renderer."""
        self._frame_number, self._developed = 0, None
        self._integrators.forget()
        self._scene.motion.forget()

    def release(self) -> None:
        """As ``reset``, and lets go of the scene of the last frame, which it else holds until the next frame."""
        self.reset()
        self._scene.release()
        self._captured_light = CapturedLightCache()

    def _sampled(
        self,
        plan: FramePlan,
        exposure: float,
        resume: Frame | None,
        progress: Progress | None,
        part: SamplePart | None = None,
    ) -> tuple[BinningCounts, SampleBudget]:
        """Samples the synced scene on the film: what was counted, and how many samples of what noise there are."""
        self._film.begin(self._scene, plan, resume, part)
        first = part.first if part is not None else 0 if resume is None else resume.samples
        self._light_warnings.warn_of_noise(plan, first + plan.samples)
        config = self.config
        is_estimated = config.noise is not None or config.time_limit is not None or progress is not None
        estimate = partial(self._film.noise, exposure) if is_estimated else None
        budget = SampleBudget(config, plan.samples, first, estimate)
        while not budget.is_spent:
            self._draw_sample(plan, exposure, self._frame_number if plan.has_history else budget.done)
            budget.add()
            if progress:
                progress(budget.label, budget.fraction)
        budget.close()
        self._frame_number += plan.has_history
        self._film.finish(self._scene)
        counts = self._binning.counts if plan.rasterises else BinningCounts()
        return replace(counts, nonfinite=counts.nonfinite + self._film.nonfinite_count), budget

    def _begin(
        self, plan: FramePlan, scene: Scene, camera: Camera, progress: Progress | None, *, encodes: bool = False
    ) -> None:
        """Loads the kernels of a frame, and syncs the scene."""
        if self._loaded != (plan, encodes):
            self._load(self._modules(plan, encodes=encodes), progress)
            self._loaded = plan, encodes
        self._launcher.stage_ms = {}
        self._sync(scene, camera, plan)
        if plan.is_unscented:
            self._unscented.begin_frame(camera)

    def _images(self, plan: FramePlan, camera: Camera, *, encodes: bool = False) -> dict[str, Any]:
        """The images on the film."""
        with self._launcher.stage("download"):
            images = self._film.images(camera.exposure, self.config, encodes=encodes)
            if "lights" in plan.aovs:
                images["light_names"] = self._scene.lights.names
            return images

    def _draw_sample(self, plan: FramePlan, exposure: float, sample: int) -> None:
        """Adds a sample of each pixel to the film."""
        self._scene.begin_sample(sample)
        rays = self._film.rays_of(sample, exposure)
        with self._launcher.frame_pass("surfaces") if plan.has_history else nullcontext():
            hits = self._find_hits(plan, rays)
        integrator = self._integrators.of(plan)
        wave = integrator.shade(self._scene, plan, hits, sample)
        self._film.add(self._scene, wave, integrator.light_images(self._scene, plan, hits))
        if self.config.time_limit is not None:
            self._launcher.synchronize()

    def trace_rays(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, *, profile: bool = False
    ) -> RayHits:
        """As the function ``trace_rays``, if the renderer has ``Pipeline.TRACE``; it keeps the hierarchies."""
        start, along = checked_rays(origins, directions)
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        start = self._local(start)
        hits = self._queries.query(self._scene, plan, start, along)
        if not profile:
            return hits
        return replace(hits, profile=self._profiles.query(self._scene, scene, start, along))

    def profile_pixels(
        self, scene: Scene, camera: Camera, ray_indices: IntArray, sample: int, offset: tuple[float, float]
    ) -> PixelProfile:
        """What rays of a camera's pixels meet, as of `RayProfiles.query_pixels`, for ``Pipeline.TRACE``."""
        plan = self._sync_rays(scene, camera)
        self._load(self._modules(plan))
        return self._profiles.query_pixels(self._scene, scene, ray_indices, sample, offset)

    def focused(self, scene: Scene, camera: Camera, x: int, y: int) -> Camera:
        """As the function ``focused``, if the renderer has ``Pipeline.TRACE`` or ``PATH``; it keeps the hierarchies."""
        start, along = checked_rays(*pixel_ray(camera, x, y))
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        (distance,) = self._profiles.surface_distances(self._scene, self._local(start), along)
        return focused_camera(camera, x, y, float(distance))

    def transmittance(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, max_distance: npt.ArrayLike = math.inf
    ) -> FloatArray:
        """As the function ``transmittance``, if the renderer has ``Pipeline.TRACE``; it keeps the hierarchies."""
        start, along = checked_rays(origins, directions)
        distances = checked_distances(max_distance, len(start))
        plan = self._sync_rays(scene)
        self._load([*self._scene.modules(plan), *self._queries.transmittance_modules()])
        return self._queries.transmittance(self._scene, self._local(start), along, distances)

    def leaving_hits(self, scene: Scene, origins: FloatArray, directions: FloatArray, offsets: FloatArray) -> RayHits:
        """What rays see that leave Gaussians, as `trace_rays`; offsets as `RayQueries.query`."""
        plan = self._sync_rays(scene)
        self._load(self._modules(plan, bounced=True))
        return self._queries.query(self._scene, plan, self._local(origins), directions, offsets)

    def leaving_transmittance(
        self, scene: Scene, origins: FloatArray, directions: FloatArray, distances: FloatArray, offsets: FloatArray
    ) -> FloatArray:
        """How much light arrives at Gaussians from points so far away, as `transmittance`."""
        plan = self._sync_rays(scene)
        self._load([*self._scene.modules(plan), *self._queries.transmittance_modules()])
        return self._queries.transmittance(self._scene, self._local(origins), directions, distances, offsets)

    def _sync_rays(self, scene: Scene, camera: Camera | None = None) -> FramePlan:
        """Syncs the scene for rays that a caller gives, or for some of a camera's."""
        if self.config.pipeline.rasterises:
            raise ConfigError("rays are traced by a renderer with Pipeline.TRACE or Pipeline.PATH: this one rasterises")
        check_scene(scene)
        if has_catcher_meshes(scene):
            scene = without_catcher_meshes(scene)
        plan = FramePlan.of_rays(self.config, scene)
        self._launcher.stage_ms = {}
        self._sync(scene, camera or _ANY_CAMERA, plan)
        return plan

    def _sync(self, scene: Scene, camera: Camera, plan: FramePlan) -> None:
        """Syncs the scene; what was found of light is forgotten if its places are about another origin now."""
        before, self._developed = self._scene.frame, None
        self._scene.sync(scene, camera, plan)
        if not np.array_equal(before.origin, self._scene.frame.origin):
            self._integrators.forget()

    def _local(self, points: npt.NDArray[np.floating]) -> FloatArray:
        """Returns world positions as the device has them, once the scene is synced, shape (N, 3)."""
        return self._scene.frame.points(points).astype(np.float32)

    def _with_captured_light(self, scene: Scene) -> Scene:
        """The scene with the light of its captures on its meshes, if it has no lights and nobody has decided."""
        if not uses_captured_light(self.config, scene):
            return scene
        return self._captured_light.lit(scene, self.config.capture_gain, self._captured_light_renderer)

    def _captured_light_renderer(self) -> Callable[[Scene, Camera], Frame]:
        """What renders captures as they are, for a short while: it has a copy of them on the device."""
        launcher = Launcher(self.device, self._launcher.threads, parallel=self._launcher.is_parallel)
        raster = replace(self.config.raster, strategy=RasterStrategy.SORTED, projection=Projection.EWA)
        config = RenderConfig(background=None, lighting=False, raster=raster, response=self.config.response)
        return Renderer(config, launcher, compiles=False).render

    def _check(self, plan: FramePlan, scene: Scene, camera: Camera, resume: Frame | None) -> None:
        """Refuses what cannot be drawn, and logs what is drawn differently."""
        check_samples(self.config, plan, resume)
        check_window(self.config, plan, camera)
        if resume is not None:
            check_resumable(resume, camera, self.config, plan)
            check_resumed_scene(resume, scene)
        check_aovs(self.config, plan)
        if plan.rasterises:
            check_projection(self.config)
            refuse_lens(camera, self.config.pipeline, self.config.raster.projection)
            self._warnings.warn_of_degree(scene)
        if plan.rasterises and self.config.pipeline.integrator is Integrator.WHITTED and scene.splats:
            self._warnings.warn_of_normals(self.config.trace)
        if plan.is_lit and not self.config.pipeline.spawns_rays:
            self._warnings.warn_of_mirrors(scene)

    def _find_hits(self, plan: FramePlan, listed: ListedRays | None) -> PrimaryHits:
        """The hits of the camera's rays of the current sample, rasterised or traced; on CUDA by a captured graph."""
        count = 0 if listed is None else len(listed.ray)

        def find() -> PrimaryHits:
            rays = self._camera_rays.start(self._scene, listed)
            if plan.rasterises and not plan.is_unscented:
                return self._raster.find_hits(self._scene, rays)
            centers = self._camera_rays.start(self._scene, of_splats=True) if plan.jitters_meshes else None
            if plan.is_unscented:
                return self._unscented.find_hits(self._scene, rays, centers)
            return self._tracer.find_hits(self._scene, rays, "camera", centers=centers)

        while True:
            hits = self._launcher.replay("hits", (self._scene.graph_key, self._binning.growth, count), find)
            if not plan.rasterises or self._binning.finish():
                return hits

    def _load(self, modules: list[KernelModule], progress: Progress | None = None) -> None:
        self._launcher.load(modules, self._progress or progress)

    def _frame(
        self,
        scene: Scene,
        camera: Camera,
        images: dict[str, Any],
        counts: BinningCounts,
        *,
        samples: int,
        noise: float | None = None,
    ) -> Frame:
        return Frame.of(
            images,
            images.pop("picture", None),
            camera=camera,
            background=self.config.background,
            samples=samples,
            config=self.config,
            draws_meshes=self._scene.plan.draws_alpha
            and any(instance.mesh.material.blends for instance in scene.meshes),
            stats=FrameStats(
                stage_ms=self._launcher.stage_ms,
                gaussian_count=scene.gaussian_count,
                visible_count=counts.visible,
                nonfinite_count=counts.nonfinite,
                pair_count=counts.pairs,
                triangle_count=scene.face_count,
                memory_bytes=self._scene.bytes + self._buffers.bytes,
                noise=noise,
            ),
        )


def create_renderer(
    config: RenderConfig | None = None,
    device: str = "auto",
    *,
    threads: int | None = None,
    profile: bool = False,
    progress: Progress | None = None,
    scene: Scene | None = None,
    encode: bool = False,
    compiles: bool = True,
) -> Renderer:
    """Returns a renderer whose kernels are compiled and loaded.

    Args:
        config: Settings; None: the defaults.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.
        threads: CPU threads; None: as many as this process may use.
        profile: Time every stage on CUDA too.
        progress: Called with a label and a fraction 0..1 while kernels compile, which takes seconds once a machine,
            also where a later frame needs further ones.
        scene: What will be rendered: all kernels of its frames are compiled at once, and none by the first frame. None:
            those of an empty scene; the first frame compiles the others.
        encode: Whether frames of the scene will be encoded, as of `Renderer.render`.
        compiles: False: nothing is compiled before the first frame, which compiles all that it needs at once.

    Raises:
        ConfigError: ``threads`` is not positive, ``config`` is no RenderConfig, or no frame of the scene can have it.
        DeviceError: There is no such device.
        SceneError: ``scene`` is no Scene.
    """
    launcher = Launcher(device, threads, profile)
    renderer = Renderer(checked_config(config), launcher, progress, compiles=compiles and scene is None)
    if scene is not None:
        renderer.prepare(scene, encode=encode)
    return renderer
