"""The render thread: draws changed views first, then refines still views."""

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
from lumisplat.viewer.session import Options, Session, State
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
    """Returns the settings that render one sample of a frame, with the AOV that a view needs.

    Args:
        config: Render settings of the scene.
        view: ``color`` or one of `lumisplat.Frame.VIEWS`.
    """
    needed = ls.Frame.NEEDS.get(view)
    samples = None if config.pipeline.is_sequence else 1
    limits = {"samples": samples, "noise": None, "time_limit": None, "adaptive": None}
    return replace(config, **limits, aovs=() if needed is None else (needed,))


class Renderers:
    """Holds one renderer per use, such as moving and still views, and reconfigures it when settings change.

    Args:
        device: Device that renders, as in `lumisplat.create_renderer`.
        progress: Receives progress messages, as in `lumisplat.create_renderer`.
    """

    def __init__(self, device: str, progress: Progress) -> None:
        self._device, self._progress = device, progress
        self._held: dict[Hashable, ls.Renderer] = {}
        _noise_log.addFilter(self._is_from_other_thread)

    def of(self, use: Hashable, config: ls.RenderConfig) -> ls.Renderer:
        """Returns the renderer of a use with the given settings. The scene stays on the device when settings change.

        Raises:
            DeviceError: The device does not exist or is out of memory.
        """
        held = self._held.get(use)
        if held is None:
            held = self._held[use] = ls.create_renderer(config, self._device, progress=self._progress, compiles=False)
        elif held.config != config:
            held.reconfigure(config)
            _return_freed_memory()
        return held

    def has(self, use: Hashable, config: ls.RenderConfig) -> bool:
        """True if the use already has a renderer with these settings."""
        held = self._held.get(use)
        return held is not None and held.config == config

    def close(self) -> None:
        """Frees all renderers."""
        self._held.clear()
        _noise_log.removeFilter(self._is_from_other_thread)

    def retain_only(self, uses: Collection[Hashable]) -> None:
        """Frees the renderers of all uses that are not listed."""
        if gone := self._held.keys() - set(uses):
            for use in gone:
                self.drop(use)
            _return_freed_memory()

    def drop(self, use: Hashable) -> None:
        """Frees the renderer of a use."""
        self._held.pop(use, None)

    def _is_from_other_thread(self, record: logging.LogRecord) -> bool:
        """Log filter that drops noise warnings of the render thread: its first samples are always noisy."""
        return record.threadName != THREAD


def _return_freed_memory() -> None:
    """Returns freed memory to the system. glibc keeps freed blocks of up to 32 MiB, of other sizes each time."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has malloc_trim
        ctypes.CDLL(None).malloc_trim(0)


_log = logging.getLogger("lumisplat")

_MOVING, _AT_REST, _BEFORE = "moving", "at rest", "before"
"""Uses of renderers shared by all pages. Realtime pipelines use one renderer per page instead."""


@dataclass(frozen=True)
class _Job:
    """A frame to render for a page."""

    page: Page
    key: tuple[int, int]
    pose: Pose
    state: State
    before: State
    """Reference state for the left side of *compare*."""
    options: Options
    moves: bool
    """True if the view moves; False if it is still."""


class RenderLoop:
    """Renders the frames of all pages in one thread.

    Args:
        session: Session to show.
        device: Device that renders.
        progress: Receives progress messages while kernels compile.
        on_frame: Called after each frame with the page, the detail step (None for a still view) and the milliseconds.
        overlay: Draws overlays on an image, such as outlines of lights.
        on_levels: Receives the progress of building levels of detail, 0 to 1.
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
        """Time of the last frame of a moving view, seconds of the monotonic clock."""
        self._levels = Levels(self._wake, on_levels, self._is_busy)
        self.scenes = SceneBuilder(self._levels, device, progress, session.report)
        """Builds the scenes of frames; only the render thread uses it."""
        self._scenes_before = SceneBuilder(self._levels, device, progress, session.report)
        self._pages: list[Page] = []
        self._background: deque[Generator[None]] = deque()
        self._background_waited = False
        """True if a still view had the last slot while a background job waited."""
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
        """Renders a small image of the scene when no view moves, with the renderer of still views.

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
        """True if a long frame must stop, because a view moved or the viewer is closing. Thread-safe."""
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
        """True if a view moves or a page waits for its first image."""
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
            self._renderers.retain_only(self._uses(job))
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
        """Returns the background job to run next; None if the frame comes first. The caller holds the lock."""
        if not self._background or (job is not None and (job.moves or not self._background_waited)):
            self._background_waited = bool(self._background)
            return None
        self._background_waited = False
        return self._background[0]

    def _step(self, steps: Generator[None]) -> None:
        """Runs one step of a background job and removes the job when it ends."""
        try:
            next(steps)
            return
        except StopIteration:
            pass
        except Exception as error:  # a failed job must not end the session
            self._report(error)
        self._background.popleft()

    def _give_up(self, job: _Job, error: Exception) -> None:
        """Reports an error and renders nothing more for the page until something changes."""
        with self._session.changed:
            job.page.key, job.page.is_finished = job.key, True
            self._session.changed.notify_all()
        self._report(error)

    def _report(self, error: Exception) -> None:
        """Reports an error to the pages and logs the traceback, unless the error is a LumisplatError."""
        if not isinstance(error, ls.LumisplatError):
            _log.error("the viewer failed to render a frame:\n%s", traceback.format_exc())
        self._session.report(" ".join(str(error).split()) or type(error).__name__)

    # --- Scheduling; the caller holds the lock ---

    def _next_job(self) -> _Job | None:
        """Returns a frame of a page whose view changed, else of an unfinished still view; None if there is no work."""
        now = time.monotonic()
        resting: Page | None = None
        for page in self._pages:
            if page.pose is None or not page.is_open:
                continue
            key = (self._session.revision, page.pose_number)
            if page.key != key:
                if page.takes_frames:
                    self._move_to_back(page)
                    return self._job(page, key, moves=True)
            elif not page.is_finished and resting is None and now - page.changed_at >= SETTLED_S:
                resting = page
        if resting is None:
            return None
        self._move_to_back(resting)
        return self._job(resting, (self._session.revision, resting.pose_number), moves=False)

    def _job(self, page: Page, key: tuple[int, int], *, moves: bool) -> _Job:
        assert page.pose is not None
        session = self._session
        return _Job(page, key, page.pose, session.state, session.opened, session.options, moves)

    def _uses(self, job: _Job) -> list[Hashable]:
        """Returns the renderer uses that the state of a job needs; the other renderers can be freed."""
        in_sequence = job.state.config.pipeline.is_sequence
        uses: list[Hashable] = [*self._pages] if in_sequence else [_MOVING, _AT_REST]
        return uses if job.options.split is None else [*uses, (_BEFORE, True), (_BEFORE, False)]

    def _move_to_back(self, page: Page) -> None:
        """Moves a page to the end of the list, so that pages take turns."""
        self._pages.remove(page)
        self._pages.append(page)

    def _time_to_rest(self) -> float | None:
        """Returns the seconds until the next view counts as still; None if no view is waiting."""
        waiting = [page.changed_at + SETTLED_S for page in self._pages if page.key is not None and not page.is_finished]
        return max(min(waiting) - time.monotonic(), 1e-3) if waiting else None

    # --- Frames ---

    def _develop(self, job: _Job) -> bool:
        """Develops the page's frame again, if only tone map, exposure or view changed; returns False otherwise."""
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
        use = page if config.pipeline.is_sequence else _AT_REST if page.frames_at_rest else _MOVING
        renderer = self._renderers.of(use, config)
        frame = renderer.develop(frame, state.exposure, encode=options.view == "color")
        shown = ScreenImage(
            self._picture(job, frame, level=0), JPEG_QUALITY_AT_REST if page.frames_at_rest else JPEG_QUALITY_MOVING
        )
        with self._session.changed:
            page.key, page.frame = job.key, frame
        page.show(shown)
        self._on_frame(page, None if page.frames_at_rest else page.detail.step, 1e3 * (time.perf_counter() - started))
        return True

    def _render_moving(self, job: _Job) -> None:
        """Renders a frame of a changed view, with as much detail as the time budget allows."""
        page, state, options = job.page, job.state, job.options
        self._moved_at = time.monotonic()
        follows = state.config.pipeline.bounces_light  # the frame time depends on the pixel count
        steps = PIXEL_STEPS if follows else GAUSSIAN_STEPS
        if page.detail.steps is not steps:
            page.detail = DetailController(steps, first=len(steps) - 2)
        elif page.key is None and not follows:
            page.detail = DetailController(first=first_step(state.document.scene(options.time).gaussian_count))
        step, started = page.detail.step, time.perf_counter()
        config = frame_config(state.config, options.view)
        in_sequence = config.pipeline.is_sequence
        is_warm = self._renderers.has(page if in_sequence else _MOVING, config)
        renderer = self._renderers.of(page if in_sequence else _MOVING, config)
        scene = self.scenes.of(state.document, config, options.time, step.level, waits=False)
        camera = job.pose.camera(max(2, round(options.height * step.scale)), state.exposure)
        frame = renderer.render(scene, camera, encode=options.view == "color")
        picture = self._picture(job, frame, step.level)
        took = 1e3 * (time.perf_counter() - started)
        if is_warm:  # the first frame compiles and uploads
            page.detail.record(took, options.budget_ms)
        with self._session.changed:
            page.key, page.frame, page.noise, page.frames_at_rest = job.key, frame, None, 0
            page.content = _frame_inputs(job, config)
            page.changed_at, page.is_finished = time.monotonic(), False
        page.show(ScreenImage(picture, JPEG_QUALITY_MOVING))
        self._on_frame(page, step, took)

    def _render_at_rest(self, job: _Job) -> None:
        """Renders the first full frame of a still view, or adds its next sample."""
        page, state, options = job.page, job.state, job.options
        started = time.perf_counter()
        config = frame_config(state.config, options.view)
        in_sequence = config.pipeline.is_sequence
        renderer = self._renderers.of(page if in_sequence else _AT_REST, config)
        camera = job.pose.camera(options.height, state.exposure)
        resume = page.frame if page.frames_at_rest and not in_sequence else None
        frame = renderer.render(
            self.scenes.of(state.document, config, options.time, 0, waits=True),
            camera,
            resume=resume,
            encode=options.view == "color",
            progress=None if in_sequence else _ignore,
            stop=self.must_yield,
        )
        rests, noise = page.frames_at_rest + 1, page.noise
        if frame.stats is not None and frame.stats.noise is not None:
            noise = frame.stats.noise
        is_finished = _is_finished(frame, rests, noise, state.config)
        shown: ScreenImage | None = None
        if page.takes_frames or is_finished:
            depth = page_depth(frame, self._session.extent.page_from_scene)
            shown = ScreenImage(self._picture(job, frame, level=0), JPEG_QUALITY_AT_REST, depth)
        with self._session.changed:
            page.frame, page.frames_at_rest, page.noise, page.is_finished = frame, rests, noise, is_finished
            page.content = _frame_inputs(job, config)
        if shown is not None:
            page.show(shown)
        self._on_frame(page, None, 1e3 * (time.perf_counter() - started))

    def _picture(self, job: _Job, frame: ls.Frame, level: int) -> Picture:
        """Returns the image that a page shows of a frame, with the comparison and overlays of the view options."""
        picture, share = frame_image(frame, job.options.view), job.options.split
        if share is not None:
            picture = split_image(self._before_image(job, frame.camera, level), picture, share)
        return self._overlay(picture, frame)

    def _before_image(self, job: _Job, camera: ls.Camera, level: int) -> Picture:
        """Renders the reference state for *compare*; a still view has `BEFORE_SAMPLES` samples per pixel."""
        page, options = job.page, job.options
        config = frame_config(job.before.config, options.view)
        if not config.pipeline.is_sequence and not job.moves:
            config = replace(config, samples=BEFORE_SAMPLES)
        camera = replace(camera, exposure=job.before.exposure)
        key = job.key, job.moves, level, camera.width, camera.height
        if page.before_image is None or page.before_image_key != key:
            renderer = self._renderers.of((_BEFORE, job.moves), config)
            scene = self._scenes_before.of(job.before.document, config, options.time, level, waits=not job.moves)
            stop = None if job.moves else self.must_yield
            frame = renderer.render(scene, camera, encode=options.view == "color", stop=stop)
            page.before_image, page.before_image_key = frame_image(frame, options.view), key
        return page.before_image


def _frame_inputs(job: _Job, config: ls.RenderConfig) -> tuple[object, ...]:
    """Returns the inputs that determine a frame before it is developed."""
    undeveloped = replace(config, tone_map=ls.ToneMap.NONE)
    return job.state.document, job.pose, undeveloped, job.options.height, job.options.time


def _has_same_inputs(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """True if two frames have the same document and equal settings."""
    return one[0] is other[0] and one[1:] == other[1:]


def _ignore(label: str, fraction: float) -> None:
    """Discards progress; passing a progress function makes the renderer estimate the noise."""


def _is_finished(frame: ls.Frame, rests: int, noise: float | None, config: ls.RenderConfig) -> bool:
    """True if a still view needs no further frame after ``rests`` frames."""
    if config.pipeline.is_sequence:
        return rests >= REALTIME_FRAMES_AT_REST
    if frame.samples == 0:
        return True  # the sorted raster is exact
    if noise is not None and noise <= (config.noise or NOISE_AT_REST):
        return True
    return frame.samples >= (config.samples or SAMPLES_AT_REST)
