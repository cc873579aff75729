"""The render thread: renders pages whose view has changed first, then adds samples to still views."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Collection, Generator, Hashable
from dataclasses import dataclass, replace

import lumisplat as ls
from lumisplat.viewer.frames.error_colors import shown_scene
from lumisplat.viewer.frames.page import (
    GAUSSIAN_STEPS,
    PIXEL_STEPS,
    DetailController,
    DetailStep,
    Page,
    Picture,
    ScreenImage,
    first_step,
    frame_image,
    page_depth,
    split_image,
)
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.frames.scene_builder import Levels, Progress, SceneBuilder
from lumisplat.viewer.session import ERROR_VIEWS, Options, Session, State
from lumisplat.viewer.thresholds import (
    BEFORE_SAMPLES,
    JPEG_QUALITY_AT_REST,
    JPEG_QUALITY_MOVING,
    NOISE_AT_REST,
    REALTIME_FRAMES_AT_REST,
    SAMPLES_AT_REST,
    SETTLED_S,
)

THREAD = "lumisplat frames"
"""Name of the render thread."""

_noise_log = logging.getLogger("lumisplat.noise")


def frame_config(config: ls.RenderConfig, view: str) -> ls.RenderConfig:
    """Returns settings for one frame: one sample per pixel, no noise or time limit, and the AOV that a view needs.

    Args:
        config: Render settings of the scene.
        view: One of `lumisplat.viewer.session.VIEWS`.
    """
    needed = ls.Frame.NEEDS.get(view)
    samples = None if config.pipeline.is_sequence else 1
    limits = {"samples": samples, "noise": None, "time_limit": None, "adaptive": None}
    lighting = False if view in ERROR_VIEWS else config.lighting
    return replace(config, **limits, lighting=lighting, aovs=() if needed is None else (needed,))


class Renderers:
    """Renderers by purpose (such as moving views, still views, or one page), created at first use.

    A purpose is any hashable key. If the settings of a purpose change, its renderer is reconfigured, not replaced.

    Args:
        device: Device that renders, as in `lumisplat.create_renderer`.
        progress: Receives progress messages, as in `lumisplat.create_renderer`.
    """

    def __init__(self, device: str, progress: Progress) -> None:
        self._device, self._progress = device, progress
        self._held: dict[Hashable, ls.Renderer] = {}
        _noise_log.addFilter(self._is_from_other_thread)

    def of(self, purpose: Hashable, config: ls.RenderConfig) -> ls.Renderer:
        """Returns the renderer of a purpose, created or reconfigured so that it has the given settings.

        Raises:
            DeviceError: The device does not exist or is out of memory.
        """
        held = self._held.get(purpose)
        if held is None:
            held = self._held[purpose] = ls.create_renderer(
                config, self._device, progress=self._progress, compiles=False
            )
        elif held.config != config:
            held.reconfigure(config)
            _return_freed_memory()
        return held

    def has(self, purpose: Hashable, config: ls.RenderConfig) -> bool:
        """True if the renderer of a purpose exists and has exactly the given settings, so that nothing must compile."""
        held = self._held.get(purpose)
        return held is not None and held.config == config

    def close(self) -> None:
        """Frees all renderers."""
        self._held.clear()
        _noise_log.removeFilter(self._is_from_other_thread)

    def retain_only(self, purposes: Collection[Hashable]) -> None:
        """Frees all renderers except those of the given purposes."""
        if gone := self._held.keys() - set(purposes):
            for purpose in gone:
                self.drop(purpose)
            _return_freed_memory()

    def drop(self, purpose: Hashable) -> None:
        """Frees the renderer of one purpose; does nothing if there is none."""
        self._held.pop(purpose, None)

    def _is_from_other_thread(self, record: logging.LogRecord) -> bool:
        """Log filter: drops warnings about noise from the render thread, where the first samples are always noisy."""
        return record.threadName != THREAD


def _return_freed_memory() -> None:
    """Makes glibc return freed memory to the system; it would keep freed blocks of up to 32 MiB, seldom reused."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has malloc_trim
        ctypes.CDLL(None).malloc_trim(0)


_log = logging.getLogger("lumisplat")

_MOVING, _AT_REST, _BEFORE = "moving", "at rest", "before"
"""Keys of the renderers that all pages share: for moving views, still views, and the earlier state of option
*compare*. A realtime pipeline uses one renderer for each page instead."""


@dataclass(frozen=True)
class _Job:
    """Request to render one frame: the page, its camera, and a snapshot of state and view options."""

    page: Page
    key: tuple[int, int]
    pose: Pose
    state: State
    before: State
    """Earlier state that option *compare* shows on the left side of the image."""
    options: Options
    moves: bool
    """True if camera or scene have changed since the last frame, which a reduced frame shows soonest; False for a full
    frame, or another sample of it."""


class RenderLoop:
    """Renders the frames of all pages, and steps of background jobs, in one thread.

    Args:
        session: Session to show.
        device: Device that renders.
        progress: Receives progress messages while kernels compile.
        on_frame: Called after each frame with the page, the `DetailStep` (None for a still view, which has full detail)
            and the frame time in milliseconds.
        overlay: Draws overlays on an image, such as outlines of lights.
        on_levels: Receives the completed fraction of building levels of detail, 0 to 1.
    """

    def __init__(
        self,
        session: Session,
        device: str,
        progress: Progress,
        *,
        on_frame: Callable[[Page, DetailStep | None, float], None],
        overlay: Callable[[Picture, ls.Frame], Picture],
        on_levels: Callable[[float], None],
    ) -> None:
        self._session, self._on_frame, self._overlay = session, on_frame, overlay
        self._renderers = Renderers(device, progress)
        self._moved_at = -math.inf
        """Start time of the last frame of a moving view, seconds of the monotonic clock."""
        self._levels = Levels(self._wake, on_levels, self._is_busy)
        self.scenes = SceneBuilder(self._levels, device, progress, session.report)
        """Builds the scene of each frame. Only code that runs in the render thread may use it."""
        self._scenes_before = SceneBuilder(self._levels, device, progress, session.report)
        self._pages: list[Page] = []
        self._background: deque[Generator[None]] = deque()
        self._background_waited = False
        """True if the last step of the thread was a frame while a background job was queued; before the next frame of
        a still view, the job then gets a step."""
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name=THREAD, daemon=True)

    def start(self) -> None:
        """Starts the render thread."""
        self._thread.start()

    def add(self, page: Page) -> None:
        """Adds a page to render for."""
        with self._session.changed:
            if page.is_open:  # a page may have closed before it was added
                self._pages.append(page)
            self._session.changed.notify_all()

    def remove(self, page: Page) -> None:
        """Stops rendering for a page and closes it."""
        with self._session.changed:
            if page in self._pages:
                self._pages.remove(page)
            self._renderers.drop(page)
        page.close()

    def run_in_background(self, steps: Generator[None]) -> None:
        """Runs a long job, such as a video, step by step while no view moves, alternating with still views.

        Args:
            steps: Generator of the job's steps. An exception is reported and ends the job. The generator is closed if
                the render loop ends first.
        """
        with self._session.changed:
            self._background.append(steps)
            self._session.changed.notify_all()

    def thumbnail(self, camera: ls.Camera, show: Callable[[Picture], object]) -> None:
        """Queues a small image of the scene, rendered with the still-view renderer once no view moves.

        Args:
            camera: Camera, with the size of the image.
            show: Receives the image, in the render thread.
        """

        def work() -> Generator[None]:
            state = self._session.state
            config = frame_config(state.config, "color")
            if config.pipeline.is_sequence:  # the first realtime frame is noisy
                config = replace(config, pipeline=ls.Pipeline.HYBRID, samples=1)
            scene = self.scenes.of(state.document, config, self._session.options.time, 0, waits=False)
            frame = self._renderers.of(_AT_REST, config).render(scene, camera)
            show(frame_image(frame, "color"))
            yield

        self.run_in_background(work())

    def must_yield(self) -> bool:
        """True if a long still frame must stop early: a page waits for a frame of a new view, or the viewer closes.

        May be called from any thread.
        """
        revision = self._session.revision
        pages = [page for page in list(self._pages) if page.pose is not None]
        return not self._is_open or any(p.key != (revision, p.pose_number) and p.takes_frames for p in pages)

    def close(self) -> None:
        """Ends the render thread after the current frame, and closes all pages."""
        with self._session.changed:
            self._is_open = False
            self._session.changed.notify_all()
            pages = list(self._pages)
        for page in pages:
            page.close()
        if self._thread.is_alive():
            self._thread.join()
        self._renderers.close()
        self._levels.close()

    def _is_busy(self) -> bool:
        """True if a view moved in the last `SETTLED_S` seconds or a page has no image yet; background work pauses."""
        with self._session.changed:
            is_waiting = any(page.key is None and page.pose is not None for page in self._pages)
        return is_waiting or time.monotonic() - self._moved_at < SETTLED_S

    def _wake(self) -> None:
        with self._session.changed:
            self._session.changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._session.changed:
                job = None
                while self._is_open and (job := self._next_job()) is None and not self._background:
                    self._session.changed.wait(self._time_to_rest())
                if not self._is_open:
                    break
                steps = self._next_background_job(job)
            if steps is not None:
                self._step(steps)
                continue
            assert job is not None
            self._renderers.retain_only(self._purposes(job))
            try:
                if job.moves:
                    if not self._develop(job):
                        self._render_moving(job)
                else:
                    self._render_at_rest(job)
            except ls.errors.StoppedError:  # the frame is rendered again later
                pass
            except Exception as error:  # a failed frame must not end the session
                self._give_up(job, error)
        for steps in self._background:
            steps.close()

    def _next_background_job(self, job: _Job | None) -> Generator[None] | None:
        """Returns the background job whose step runs next, or None if there is none or a frame is rendered first.

        Frames of moving views come first; frames of still views alternate with steps. The caller holds the lock.

        Args:
            job: Next frame to render; None if no page needs one.
        """
        if not self._background or (job is not None and (job.moves or not self._background_waited)):
            self._background_waited = bool(self._background)
            return None
        self._background_waited = False
        return self._background[0]

    def _step(self, steps: Generator[None]) -> None:
        """Runs one step of a background job; removes the job from the queue when it has ended or failed."""
        try:
            next(steps)
            return
        except StopIteration:
            pass
        except Exception as error:  # a failed job must not end the session
            self._report(error)
        self._background.popleft()

    def _give_up(self, job: _Job, error: Exception) -> None:
        """Reports why a frame failed, and does not retry it until the page's camera or the scene changes."""
        with self._session.changed:
            job.page.key, job.page.is_finished = job.key, True
            self._session.changed.notify_all()
        self._report(error)

    def _report(self, error: Exception) -> None:
        """Shows an error on the pages; an unexpected one (no LumisplatError) is also logged with its traceback."""
        if not isinstance(error, ls.LumisplatError):
            _log.error("the viewer failed to render a frame:\n%s", traceback.format_exc())
        self._session.report(" ".join(str(error).split()) or type(error).__name__)

    # --- Scheduling; the caller holds the lock ---

    def _next_job(self) -> _Job | None:
        """Returns the next frame to render: of a page whose view changed, else of a still view that needs samples.

        Returns None if all pages are finished.
        """
        now = time.monotonic()
        resting: Page | None = None
        for page in self._pages:
            if page.pose is None or not page.is_open:
                continue
            key = (self._session.revision, page.pose_number)
            if page.key != key:
                if page.takes_frames:
                    self._move_to_back(page)
                    return self._job(page, key, moves=not page.skips_reduced(key[0]))
            elif not page.is_finished and resting is None and now >= page.rests_at:
                resting = page
        if resting is None:
            return None
        self._move_to_back(resting)
        return self._job(resting, (self._session.revision, resting.pose_number), moves=False)

    def _job(self, page: Page, key: tuple[int, int], *, moves: bool) -> _Job:
        assert page.pose is not None
        session = self._session
        return _Job(page, key, page.pose, session.state, session.opened, session.options, moves)

    def _purposes(self, job: _Job) -> list[Hashable]:
        """Returns the keys of the renderers that frames of the current settings use; all others can be freed."""
        in_sequence = job.state.config.pipeline.is_sequence
        purposes: list[Hashable] = [*self._pages] if in_sequence else [_MOVING, _AT_REST]
        return purposes if job.options.split is None else [*purposes, (_BEFORE, True), (_BEFORE, False)]

    def _move_to_back(self, page: Page) -> None:
        """Moves a page to the end of the list of pages, so that all pages get frames in turn."""
        self._pages.remove(page)
        self._pages.append(page)

    def _time_to_rest(self) -> float | None:
        """Returns the seconds until a view that has stopped moving gets full frames; None if all pages are finished."""
        waiting = [page.rests_at for page in self._pages if page.key is not None and not page.is_finished]
        return max(min(waiting) - time.monotonic(), 1e-3) if waiting else None

    # --- Frames ---

    def _develop(self, job: _Job) -> bool:
        """Shows the page's last frame again with a new exposure, tone map or AOV view, without rendering.

        Returns False, and does nothing, if camera, document or other settings have changed, or *compare* is on.
        """
        page, state, options = job.page, job.state, job.options
        config = frame_config(state.config, options.view)
        frame, content = page.frame, _frame_inputs(job, config)
        if (
            frame is None
            or options.split is not None
            or page.content is None
            or not _has_same_inputs(page.content, content)
        ):
            return False
        started = time.perf_counter()
        purpose = page if config.pipeline.is_sequence else _AT_REST if page.frames_at_rest else _MOVING
        renderer = self._renderers.of(purpose, config)
        frame = renderer.develop(frame, state.exposure, encode=options.view not in ls.Frame.VIEWS)
        shown = ScreenImage(
            self._picture(job, frame, level=0), JPEG_QUALITY_AT_REST if page.frames_at_rest else JPEG_QUALITY_MOVING
        )
        with self._session.changed:
            page.key, page.frame = job.key, frame
        page.show(shown)
        self._on_frame(page, None if page.frames_at_rest else page.detail.step, 1e3 * (time.perf_counter() - started))
        return True

    def _render_moving(self, job: _Job) -> None:
        """Renders one frame of a changed view, at the level of detail and resolution that fit the time budget."""
        page, state, options = job.page, job.state, job.options
        self._moved_at = time.monotonic()
        is_limited_by_pixels = state.config.pipeline.bounces_light  # the frame time depends on the pixel count
        steps = PIXEL_STEPS if is_limited_by_pixels else GAUSSIAN_STEPS
        if page.detail.steps is not steps:
            page.detail = DetailController(steps, first=len(steps) - 2)
        elif page.key is None and not is_limited_by_pixels:
            page.detail = DetailController(first=first_step(state.document.scene(options.time).gaussian_count))
        step, started = page.detail.step, time.perf_counter()
        config = frame_config(state.config, options.view)
        in_sequence = config.pipeline.is_sequence
        is_warm = self._renderers.has(page if in_sequence else _MOVING, config)
        renderer = self._renderers.of(page if in_sequence else _MOVING, config)
        scene = shown_scene(self.scenes.of(state.document, config, options.time, step.level, waits=False), options.view)
        camera = job.pose.camera(max(2, round(options.height * step.scale)), state.exposure)
        frame = renderer.render(scene, camera, encode=options.view not in ls.Frame.VIEWS)
        picture = self._picture(job, frame, step.level)
        took = 1e3 * (time.perf_counter() - started)
        if is_warm:  # the first frame compiles and uploads
            page.detail.record(took, options.budget_ms)
        with self._session.changed:
            only_camera_moved = page.key is not None and page.key[0] == job.key[0]
            page.key, page.frame, page.noise, page.frames_at_rest = job.key, frame, None, 0
            page.content = _frame_inputs(job, config)
            page.rests_at, page.is_finished = time.monotonic() + SETTLED_S, False
            if only_camera_moved and not in_sequence:  # a full frame is abandoned if the camera moves on
                page.rests_at = min(page.rests_at, page.stops_at)
        page.show(ScreenImage(picture, JPEG_QUALITY_MOVING))
        self._on_frame(page, step, took)

    def _render_at_rest(self, job: _Job) -> None:
        """Renders the first frame of a still view at full detail, or adds one sample per pixel to it."""
        page, state, options = job.page, job.state, job.options
        started = time.perf_counter()
        config = frame_config(state.config, options.view)
        in_sequence, content = config.pipeline.is_sequence, _frame_inputs(job, config)
        with self._session.changed:
            if page.key != job.key:  # the page has said that its camera has stopped
                page.key, page.is_finished, page.rests_at = job.key, False, time.monotonic()
        renderer = self._renderers.of(page if in_sequence else _AT_REST, config)
        camera = job.pose.camera(options.height, state.exposure)
        is_first = not page.frames_at_rest or page.content is None or not _has_same_inputs(page.content, content)
        frame = renderer.render(
            shown_scene(self.scenes.of(state.document, config, options.time, 0, waits=True), options.view),
            camera,
            resume=None if is_first or in_sequence else page.frame,
            encode=options.view not in ls.Frame.VIEWS,
            progress=None if in_sequence else _ignore,
            stop=self.must_yield,
        )
        frame_count, noise = (1, None) if is_first else (page.frames_at_rest + 1, page.noise)
        if frame.stats is not None and frame.stats.noise is not None:
            noise = frame.stats.noise
        is_finished = _is_finished(frame, frame_count, noise, state.config)
        shown: ScreenImage | None = None
        if page.takes_frames or is_finished:
            depth = page_depth(frame, self._session.extent.page_from_scene)
            shown = ScreenImage(self._picture(job, frame, level=0), JPEG_QUALITY_AT_REST, depth)
        page.full_ms = 1e3 * (time.perf_counter() - started)
        with self._session.changed:
            page.frame, page.frames_at_rest, page.noise, page.is_finished = frame, frame_count, noise, is_finished
            page.content = content
        if shown is not None:
            page.show(shown)
        self._on_frame(page, None, page.full_ms)

    def _picture(self, job: _Job, frame: ls.Frame, level: int) -> Picture:
        """Converts a frame to an sRGB image; adds the *compare* side and the overlays that the view options select."""
        picture, share = frame_image(frame, job.options.view), job.options.split
        if share is not None:
            picture = split_image(self._before_image(job, frame.camera, level), picture, share)
        return self._overlay(picture, frame)

    def _before_image(self, job: _Job, camera: ls.Camera, level: int) -> Picture:
        """Returns the image of the earlier state for option *compare*, rendered again only if camera or scene changed.

        A still view has `BEFORE_SAMPLES` samples per pixel, a moving view one.
        """
        page, options = job.page, job.options
        config = frame_config(job.before.config, options.view)
        if not config.pipeline.is_sequence and not job.moves:
            config = replace(config, samples=BEFORE_SAMPLES)
        camera = replace(camera, exposure=job.before.exposure)
        key = job.key, job.moves, level, camera.width, camera.height
        if page.before_image is None or page.before_image_key != key:
            renderer = self._renderers.of((_BEFORE, job.moves), config)
            scene = self._scenes_before.of(job.before.document, config, options.time, level, waits=not job.moves)
            scene = shown_scene(scene, options.view)
            stop = None if job.moves else self.must_yield
            frame = renderer.render(scene, camera, encode=options.view not in ls.Frame.VIEWS, stop=stop)
            page.before_image, page.before_image_key = frame_image(frame, options.view), key
        return page.before_image


def _frame_inputs(job: _Job, config: ls.RenderConfig) -> tuple[object, ...]:
    """Returns what a frame depends on before tone mapping: document, camera, settings, height and time."""
    undeveloped = replace(config, tone_map=ls.ToneMap.NONE)
    error = job.options.view if job.options.view in ERROR_VIEWS else None
    return job.state.document, job.pose, undeveloped, job.options.height, job.options.time, error


def _has_same_inputs(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """True if two results of `_frame_inputs` hold the same document object, by identity, and equal other values."""
    return one[0] is other[0] and one[1:] == other[1:]


def _ignore(label: str, fraction: float) -> None:
    """Progress function that does nothing; a renderer estimates the noise only if it is given a progress function."""


def _is_finished(frame: ls.Frame, frame_count: int, noise: float | None, config: ls.RenderConfig) -> bool:
    """True if a still view needs no further frame: enough samples or frames, noise below the limit, or exact raster.

    Args:
        frame: Last frame of the view; 0 samples mean the sorted raster pipeline, whose image is exact.
        frame_count: Number of frames rendered since the view stopped moving.
        noise: Estimated relative error; None if unknown.
        config: Render settings of the scene, which may limit samples and noise.
    """
    if config.pipeline.is_sequence:
        return frame_count >= REALTIME_FRAMES_AT_REST
    if frame.samples == 0:
        return True  # the sorted raster is exact
    if noise is not None and noise <= (config.noise or NOISE_AT_REST):
        return True
    return frame.samples >= (config.samples or SAMPLES_AT_REST)
