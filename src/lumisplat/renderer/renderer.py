"""The renderer: computes a frame of a scene and a camera by a list of passes."""

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
from lumisplat.device.structs.camera import ListedRays
from lumisplat.errors import ConfigError, DeviceError
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
from lumisplat.renderer.raster.ray_tiles import RayTiles
from lumisplat.renderer.raster.splat_raster import SplatRaster
from lumisplat.renderer.raster.unlit_raster import UnlitRaster
from lumisplat.renderer.raster.unscented_raster import UnscentedRaster
from lumisplat.renderer.rays import PixelProfile, RayHits, RayProfiles, RayQueries, checked_distances, checked_rays
from lumisplat.renderer.sample_budget import SampleBudget
from lumisplat.renderer.scene.camera_table import check_camera, refuse_lens
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import CapturedLight, FramePlan
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.gaussian_trace import RayLists
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.ops.views import focused_camera, pixel_ray
from lumisplat.scene.scene import Scene

_ANY_CAMERA = Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""Arbitrary camera with which a scene is synced for rays of a caller, because the tables need one."""


class Renderer:
    """Renders frames, and reuses assets, buffers and compiled kernels from frame to frame. Not thread-safe.

    Args:
        config: Settings; the defaults draw a capture as it was trained.
        launcher: Launches kernels on the device.
        progress: As for ``create_renderer``.
        compiles: As for ``create_renderer``.
        buffers: Holds the renderer's arrays; None: new buffers.
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
        self._ray_tiles = RayTiles(launcher, buffers, config, binning)
        self._lists: RayLists | None = None
        """Gaussians that the camera rays of the current frame may hit; None: the rays traverse BVHs."""
        self._integrators = Integrators(launcher, buffers, config, self._tracer)
        self._film = Film(launcher, buffers)
        self._queries = RayQueries(launcher, buffers, config, self._tracer, self._integrators)
        self._profiles = RayProfiles(launcher, buffers, config)
        self._warnings = RasterWarnings()
        self._light_warnings = LightWarnings()
        self._captured_light = CapturedLightCache()
        self._developed: FrameStats | None = None
        """Statistics of the last frame while the film still holds that frame's samples; else None."""
        self._loaded: tuple[FramePlan, bool] | None = None
        """Plan for which kernels were loaded last, and whether the kernels that encode bytes were among them; None: no
        kernels are loaded."""
        self._frame_number = 0
        """Index of the next frame in a real-time sequence."""
        self._catchers: Renderer | None = None
        """Renderer of the frames that measure shadows on catcher meshes; None until a scene has such meshes."""
        if compiles:
            self._load(self._modules(self._plan_of(Scene())))

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def prepare(self, scene: Scene, *, encode: bool = False, progress: Progress | None = None) -> None:
        """Compiles and loads the kernels that frames of a scene need, so that the first frame compiles nothing.

        Args:
            scene: The scene that will be rendered; nothing is uploaded.
            encode: As for `render`.
            progress: Called with a label and the fraction done, 0..1.

        Raises:
            ConfigError: The settings do not allow frames of the scene, whatever the camera.
            SceneError: ``scene`` is no Scene.
        """
        check_scene(scene)
        modules: list[KernelModule] = []
        if has_catcher_meshes(scene):
            for caught in catcher_scenes(scene):
                modules += self._catcher_renderer()._modules_of(caught)
            scene = without_catcher_meshes(scene)
        plan = self._plan_of(scene)
        check_aovs(self.config, plan)
        if plan.rasterises:
            check_projection(self.config)
        self._load([*modules, *self._modules_of(scene, encode=encode)], progress)

    def _modules_of(self, scene: Scene, *, encode: bool = False) -> list[KernelModule]:
        """Returns the kernel modules of a scene's frames, the slowest to compile first."""
        modules: list[KernelModule] = []
        if uses_captured_light(self.config, scene):  # the plan has a headlight if captures do not surround the meshes
            light = CapturedLight(visible=False, casts_shadow=False)
            modules += self._modules(self._plan_of(replace(scene, lights=(light,))), encodes=encode)
            modules += self._unlit_raster.modules(has_meshes=False)
        return [*modules, *self._modules(self._plan_of(scene), encodes=encode)]

    def _modules(self, plan: FramePlan, *, bounced: bool = False, encodes: bool = False) -> list[KernelModule]:
        """Returns the kernel modules of a plan's frames or, if ``bounced``, of a caller's rays that start at surfaces.

        ``encodes``: frames are also encoded to 8 bits on the device.
        """
        others = [*self._scene.modules(plan), *self._film.modules(plan, encodes=encodes)]
        if not plan.is_sampled:
            return [
                *self._unlit_raster.modules(has_meshes=plan.has_meshes, merges_sets=plan.merges_sets),
                *others,
            ]
        if plan.is_unscented:
            hits = self._unscented.modules(plan)
        elif plan.rasterises:
            hits = self._raster.modules(plan)
        else:
            hits = self._tracer.modules(plan, bounced=bounced)
            if plan.lists_gaussians:
                hits = [*self._tracer.camera_modules(plan), *self._ray_tiles.modules()]
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
            scene: The scene to render. Assets of the last frame are not uploaded again. If a capture replaces one with
                as many Gaussians, the ray tracer refits its BVH instead of building a new one.
            camera: The camera. A frame of ``Pipeline.REALTIME`` continues a sequence: it reuses the lighting of earlier
                frames, even if objects or the camera have moved; ``reset`` drops the reused lighting.
            resume: A sampled frame of the same scene, camera and settings, except for ``samples`` and ``time_limit``.
                New samples are added to the frame's samples, and the result equals a frame rendered with all samples at
                once.
            encode: Whether the device tone-maps the frame and encodes its bytes, which speeds up ``numpy.asarray(frame,
                numpy.uint8)`` and saving a PNG; CUDA always does.
            progress: Called after each sample with a label and the fraction done, 0..1. The label contains the number
                of samples and, once there are enough samples for an estimate, the noise, separated by commas.
            stop: Polled often while a CPU renders the frame, from any thread. When it returns True, the frame is
                abandoned and the renderer is unchanged. Real-time frames depend on each other and are always finished.

        Raises:
            StoppedError: ``stop`` returned True.
            ConfigError: ``resume`` is no frame, has another camera, other settings or another number of Gaussians or
                triangles, is rasterised, or has too many samples.
            DeviceError: The device is out of memory.
            SceneError: ``scene`` or ``camera`` has the wrong type, the scene or the image exceeds 32-bit indices, or
                the camera is not a pinhole or too distorted for the rasteriser.
        """
        check_scene(scene)
        check_camera(camera)
        if has_catcher_meshes(scene):
            if resume is not None:
                raise ConfigError(
                    "a frame with meshes that are shadow catchers cannot be resumed: render all samples at once"
                )
            return self._with_caught_shadows(scene, camera, progress, stop)
        scene = self._with_captured_light(scene)
        plan = self._plan_of(scene, camera)
        if plan.rasterises and not plan.is_unscented and camera.is_distorted:
            refuse_lens(camera, self.config.pipeline)
            if resume is not None:
                raise ConfigError(
                    "a rasterised frame of a distorting lens is resampled and cannot be resumed: use Pipeline.TRACE"
                )
            pinhole = self.render(scene, pinhole_of(camera), progress=progress)
            self._developed = None
            return redistorted(pinhole, camera)
        self._check(plan, scene, camera, resume)
        plan = self._begin(plan, scene, camera, progress, encodes=encode, stop=stop)
        if not plan.is_sampled:
            with self._launcher.stoppable(stop):
                pixels = self._unlit_raster.draw(self._scene)
            with self._launcher.stage("download"):
                transparent = self.config.background is None
                images = self._film.unlit_images(pixels, transparent=transparent, encodes=encode)
                return self._frame(scene, camera, images, self._binning.counts, samples=0)

        with self._launcher.stoppable(None if plan.has_history else stop):
            counts, budget = self._sampled(plan, camera.exposure, resume, progress)
        images = self._images(plan, camera, encodes=encode)
        self._light_warnings.warn_of_media(plan, scene, self._buffers, self._launcher)
        frame = self._frame(scene, camera, images, counts, samples=budget.done, noise=budget.noise)
        self._developed = frame.stats
        return frame

    def _with_caught_shadows(
        self, scene: Scene, camera: Camera, progress: Progress | None, stop: Callable[[], bool] | None
    ) -> Frame:
        """Renders a scene with catcher meshes: the scene without them, then shadows that a second renderer measures."""
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
        """Returns the renderer of the frames that measure shadows on catcher meshes."""
        if self._catchers is None:
            self._catchers = Renderer(catcher_config(self.config), self._launcher, compiles=False)
        return self._catchers

    def render_part(self, scene: Scene, camera: Camera, part: SamplePart, *, progress: Progress | None = None) -> Frame:
        """Renders consecutive samples of a frame, or develops a frame from the samples that ``part`` already holds.

        `lumisplat.farm.render_samples` and `lumisplat.farm.merge_samples` call this method.
        """
        check_scene(scene)
        check_camera(camera)
        if has_catcher_meshes(scene):
            raise ConfigError(
                "samples of a frame with meshes that are shadow catchers cannot be split: render it in one process"
            )
        scene = self._with_captured_light(scene)
        plan = self._plan_of(scene, camera)
        check_blocks(self.config, plan, camera)
        self._check(plan, scene, camera, None)
        plan = self._begin(plan, scene, camera, progress)
        counts = BinningCounts()
        if part.accumulated:
            self._film.begin(self._scene, plan, part=part)
            self._film.finish(self._scene)
        else:
            plan = replace(plan, samples=part.count)
            counts = replace(self._sampled(plan, camera.exposure, None, progress, part)[0], nonfinite=0)
        images = self._images(plan, camera)
        return self._frame(scene, camera, images, counts, samples=part.count)

    def reconfigure(self, config: RenderConfig) -> None:
        """Changes the settings. The next frames equal the frames of a new renderer to the bit.

        Assets and their BVHs stay on the device; a new renderer would upload and build them again. A sequence of
        ``Pipeline.REALTIME`` restarts, as after ``reset``, and buffers of another pipeline are freed. If only
        ``tone_map`` changes, sequences continue and samples are reused: `develop` applies the tone map to frames.

        Args:
            config: The new settings.

        Raises:
            ConfigError: ``config`` is no RenderConfig, or its settings exclude each other; the renderer is unchanged.
            DeviceError: The device is out of memory; the renderer is unchanged.
        """
        before, config = self.config, checked_config(config)
        if replace(config, tone_map=before.tone_map) == before:
            self.config = config
            return
        has_same_buffers = config.pipeline is before.pipeline and not config.pipeline.is_sequence
        buffers = self._buffers if has_same_buffers else None
        other = Renderer(config, self._launcher, self._progress, compiles=False, buffers=buffers)
        other._scene.take_assets(self._scene)
        other._warnings, other._light_warnings = self._warnings, self._light_warnings  # each warning is logged once
        self._launcher.drop_graphs()
        vars(self).update(vars(other))

    def develop(self, frame: Frame, exposure: float | None = None, *, encode: bool = False) -> Frame:
        """Returns a frame with this renderer's current tone map and another exposure, without rendering new samples.

        Args:
            frame: A frame of this renderer. The last rendered frame is developed from the samples on the device.
            exposure: Exposure in stops; None: unchanged.
            encode: As for `render`.
        """
        camera = frame.camera if exposure is None else replace(frame.camera, exposure=exposure)
        config = None if frame.config is None else replace(frame.config, tone_map=self.config.tone_map)
        is_on_film = self._developed is not None and frame.stats is self._developed and not frame.is_denoised
        encodes = is_on_film and (encode or self._buffers.downloads.is_lazy)
        return frame.developed(camera, config, self._film.picture(camera.exposure, self.config) if encodes else None)

    def reset(self) -> None:
        """Drops the history of ``Pipeline.REALTIME``: the next frame equals the first frame of a new renderer."""
        self._frame_number, self._developed = 0, None
        self._integrators.forget()
        self._scene.motion.forget()

    def release(self) -> None:
        """Drops the history, as ``reset`` does, and frees the assets of the last frame on the device."""
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
        """Renders all samples of the synced scene; returns counters of the passes, and the budget afterwards."""
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
        self._light_warnings.warn_of_noise_level(budget.close())
        self._frame_number += plan.has_history
        self._film.finish(self._scene)
        counts = self._binning.counts if plan.rasterises else BinningCounts()
        return counts, budget

    def _begin(
        self,
        plan: FramePlan,
        scene: Scene,
        camera: Camera,
        progress: Progress | None,
        *,
        encodes: bool = False,
        stop: Callable[[], bool] | None = None,
    ) -> FramePlan:
        """Loads the kernels that a frame needs, uploads what changed in the scene, and lists Gaussians by tiles.

        ``encodes``: the frame is also encoded to 8 bits on the device. ``stop``: as for `render`.

        Returns:
            The plan; without lists if the device cannot hold them.
        """
        if self._loaded != (plan, encodes):
            self._load(self._modules(plan, encodes=encodes), progress)
            self._loaded = plan, encodes
        self._launcher.stage_ms = {}
        self._sync(scene, camera, plan)
        if plan.is_unscented:
            self._unscented.begin_frame(camera)
        self._lists = None
        if plan.lists_gaussians and scene.gaussian_count > 0:
            self._ray_tiles.begin_frame(scene, camera, plan)
            try:
                with self._launcher.stoppable(None if plan.has_history else stop):
                    self._lists = self._ray_tiles.list(self._scene)
            except DeviceError:
                return self._begin(replace(plan, lists_gaussians=False), scene, camera, progress, encodes=encodes)
        return plan

    def _images(self, plan: FramePlan, camera: Camera, *, encodes: bool = False) -> dict[str, Any]:
        """Returns the finished frame's images by field name; on CUDA, functions that download images when called."""
        with self._launcher.stage("download"):
            images = self._film.images(camera.exposure, self.config, encodes=encodes)
            if "lights" in plan.aovs:
                images["light_names"] = self._scene.lights.names
            return images

    def _draw_sample(self, plan: FramePlan, exposure: float, sample: int) -> None:
        """Renders one sample of each pixel, and adds it to the film.

        CUDA replays two recorded graphs. The first can be drawn again until its lists have room for all splats and
        rays; the second changes what later samples add to.
        """
        scene, integrator = self._scene, self._integrators.of(plan)
        scene.begin_sample(sample)
        listed = self._film.rays_of(sample, exposure)
        integrator.begin_sample(scene, sample)
        count = 0 if listed is None else len(listed.ray)

        def draw() -> tuple[PrimaryHits, RayWave]:
            with self._launcher.frame_pass("surfaces") if plan.has_history else nullcontext():
                hits = self._find_hits(plan, listed)
            return hits, integrator.shade(scene, plan, hits)

        def store(hits: PrimaryHits, wave: RayWave) -> None:
            integrator.finish(scene, plan, wave)
            self._film.add(scene, wave, integrator.light_images(scene, plan, hits))

        while True:
            key = scene.graph_key, integrator.graph_key(scene), self._ray_tiles.graph_key, self._binning.growth, count
            drawn = self._launcher.replay(f"sample {integrator.parity}", key, draw)
            has_room = self._binning.finish() if plan.rasterises else True
            if integrator.is_complete(plan) and has_room:
                break
        self._launcher.replay(f"store {integrator.parity}", key, lambda: store(*drawn))
        if self.config.time_limit is not None:
            self._launcher.synchronize()

    def trace_rays(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, *, profile: bool = False
    ) -> RayHits:
        """Traces rays like the function `lumisplat.trace_rays`, reusing BVHs of earlier calls.

        The renderer's pipeline must be ``TRACE`` or ``PATH``.
        """
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
        """Lists the hits of rays through camera pixels; the last three arguments are as in `RayProfiles.query_pixels`.

        The renderer's pipeline must be ``TRACE``.
        """
        plan = self._sync_rays(scene, camera)
        self._load(self._modules(plan))
        return self._profiles.query_pixels(self._scene, scene, ray_indices, sample, offset)

    def focused(self, scene: Scene, camera: Camera, x: int, y: int) -> Camera:
        """Returns the camera focused on the surface at pixel (x, y), like the function `lumisplat.focused`.

        The renderer's pipeline must be ``TRACE`` or ``PATH``. BVHs of earlier calls are reused.
        """
        start, along = checked_rays(*pixel_ray(camera, x, y))
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        (distance,) = self._profiles.surface_distances(self._scene, self._local(start), along)
        return focused_camera(camera, x, y, float(distance))

    def transmittance(
        self, scene: Scene, origins: npt.ArrayLike, directions: npt.ArrayLike, max_distance: npt.ArrayLike = math.inf
    ) -> FloatArray:
        """Returns transmittances along rays like the function `lumisplat.transmittance`.

        The renderer's pipeline must be ``TRACE`` or ``PATH``. BVHs of earlier calls are reused.
        """
        start, along = checked_rays(origins, directions)
        distances = checked_distances(max_distance, len(start))
        plan = self._sync_rays(scene)
        self._load([*self._scene.modules(plan), *self._queries.transmittance_modules()])
        return self._queries.transmittance(self._scene, self._local(start), along, distances)

    def leaving_hits(self, scene: Scene, origins: FloatArray, directions: FloatArray, offsets: FloatArray) -> RayHits:
        """Traces rays that leave Gaussians, and returns their hits; all arguments are as for `RayQueries.query`."""
        plan = self._sync_rays(scene)
        self._load(self._modules(plan, bounced=True))
        return self._queries.query(self._scene, plan, self._local(origins), directions, offsets)

    def leaving_transmittance(
        self, scene: Scene, origins: FloatArray, directions: FloatArray, distances: FloatArray, offsets: FloatArray
    ) -> FloatArray:
        """Returns the transmittance, up to ``distances``, of rays that leave Gaussians; see `RayQueries.query`."""
        plan = self._sync_rays(scene)
        self._load([*self._scene.modules(plan), *self._queries.transmittance_modules()])
        return self._queries.transmittance(self._scene, self._local(origins), directions, distances, offsets)

    def _sync_rays(self, scene: Scene, camera: Camera | None = None) -> FramePlan:
        """Syncs the scene for rays that a caller gives, or for chosen rays of a camera."""
        if self.config.pipeline.rasterises:
            raise ConfigError("rays are traced by a renderer with Pipeline.TRACE or Pipeline.PATH: this one rasterises")
        check_scene(scene)
        if has_catcher_meshes(scene):
            scene = without_catcher_meshes(scene)
        plan = FramePlan.of_rays(self.config, scene)
        self._launcher.stage_ms = {}
        self._sync(scene, camera or _ANY_CAMERA, plan)
        return plan

    def _plan_of(self, scene: Scene, camera: Camera | None = None) -> FramePlan:
        """Returns the plan of a frame; ``camera`` is as for `FramePlan.with_lists`."""
        return FramePlan.of(self.config, scene).with_lists(scene, camera)

    def _sync(self, scene: Scene, camera: Camera, plan: FramePlan) -> None:
        """Uploads what changed in the scene; drops cached lighting of earlier frames if the device's origin moved."""
        before, self._developed = self._scene.frame, None
        self._scene.sync(scene, camera, plan)
        if not np.array_equal(before.origin, self._scene.frame.origin):
            self._integrators.forget()

    def _local(self, points: npt.NDArray[np.floating]) -> FloatArray:
        """Converts N world-space points to coordinates relative to the origin of the synced scene, shape (N, 3)."""
        return self._scene.frame.points(points).astype(np.float32)

    def _with_captured_light(self, scene: Scene) -> Scene:
        """Returns the scene, with an environment light of its captures if `uses_captured_light` is true."""
        if not uses_captured_light(self.config, scene):
            return scene
        return self._captured_light.lit(scene, self.config.capture_gain, self._captured_light_renderer)

    def _captured_light_renderer(self) -> Callable[[Scene, Camera], Frame]:
        """Returns a function that renders captures unlit, by a second renderer with its own copy of the captures."""
        launcher = Launcher(self.device, self._launcher.threads, parallel=self._launcher.is_parallel)
        raster = replace(self.config.raster, strategy=RasterStrategy.SORTED, projection=Projection.EWA)
        config = RenderConfig(background=None, lighting=False, raster=raster, response=self.config.response)
        return Renderer(config, launcher, compiles=False).render

    def _check(self, plan: FramePlan, scene: Scene, camera: Camera, resume: Frame | None) -> None:
        """Raises an error if the frame cannot be rendered, and logs which effects are approximated."""
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
        if plan.is_lit and not self.config.pipeline.spawns_rays:
            self._warnings.warn_of_mirrors(scene)

    def _find_hits(self, plan: FramePlan, listed: ListedRays | None) -> PrimaryHits:
        """Returns the hits of the current sample's camera rays, rasterised or traced.

        If `Binning.finish` returns False, a tile list was too short, and rasterised hits are incomplete. ``listed``
        limits the sample to some rays (adaptive sampling); None: all pixels.
        """
        rays = self._camera_rays.start(self._scene, listed)
        if plan.rasterises and not plan.is_unscented:
            return self._raster.find_hits(self._scene, rays)
        centers = self._camera_rays.start(self._scene, of_splats=True) if plan.jitters_meshes else None
        if plan.is_unscented:
            return self._unscented.find_hits(self._scene, rays, centers)
        from_eye, lists = self._scene.has_one_eye, self._lists
        return self._tracer.find_hits(self._scene, rays, "camera", from_eye=from_eye, centers=centers, lists=lists)

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
        left_out = self._film.nonfinite_count if samples else None
        return Frame.of(
            images,
            images.pop("picture", None),
            camera=camera,
            background=self.config.background,
            samples=samples,
            config=self.config,
            draws_meshes=self._scene.plan.draws_alpha
            and any(instance.mesh.material.blends for instance in scene.meshes),
            stats=FrameStats.counting_later(
                lambda: counts.nonfinite + (0 if left_out is None else left_out()),
                stage_ms=self._launcher.stage_ms,
                gaussian_count=scene.gaussian_count,
                visible_count=counts.visible,
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
    """Returns a renderer with compiled and loaded kernels.

    Args:
        config: Settings; None: the defaults.
        device: ``auto`` (CUDA if there is one), ``cpu``, ``cuda`` or ``cuda:N``.
        threads: CPU threads; None: as many as this process may use.
        profile: Whether to time every stage on CUDA, too; on the CPU, stages are always timed.
        progress: Called with a label and a fraction 0..1 while kernels compile, also when a later frame needs more
            kernels. Compiling takes seconds, once per machine.
        scene: The scene to render: all kernels of its frames are compiled now, and none by the first frame. None:
            kernels of an empty scene are compiled now, and further kernels by the first frame.
        encode: Whether frames of the scene will be encoded, as for `Renderer.render`.
        compiles: Whether to compile kernels now; False: the first frame compiles all kernels that it needs.

    Raises:
        ConfigError: ``threads`` is not positive, ``config`` is no RenderConfig, or ``config`` does not allow frames of
            the scene.
        DeviceError: The device does not exist.
        SceneError: ``scene`` is no Scene.
    """
    launcher = Launcher(device, threads, profile)
    renderer = Renderer(checked_config(config), launcher, progress, compiles=compiles and scene is None)
    if scene is not None:
        renderer.prepare(scene, encode=encode)
    return renderer
