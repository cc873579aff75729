"""The thread that renders: what has changed first, then finer frames of views at rest."""

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
"""Name of the thread that renders."""

_noise_log = logging.getLogger("lumisplat.noise")


def frame_config(config: ls.RenderConfig, view: str) -> ls.RenderConfig:
    """Settings of one sample of a frame, with the images that a view needs.

    Args:
        config: The settings of the scene.
        view: ``color``, or one of `lumisplat.Frame.VIEWS`.
    """
    needed = ls.Frame.NEEDS.get(view)
    samples = None if config.pipeline.is_sequence else 1
    limits = {"samples": samples, "noise": None, "time_limit": None, "adaptive": None}
    return replace(config, **limits, aovs=() if needed is None else (needed,))


class Renderers:
    """Holds the renderers of the present settings.

    Args:
        device: As of `lumisplat.create_renderer`.
        progress: Likewise.
    """

    def __init__(self, device: str, progress: Progress) -> None:
        self._device, self._progress = device, progress
        self._held: dict[Hashable, ls.Renderer] = {}
        _noise_log.addFilter(self._is_from_other_thread)

    def of(self, use: Hashable, config: ls.RenderConfig) -> ls.Renderer:
        """Returns the renderer of a use, with these settings; the scene stays on its device when they change.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
        """
        held = self._held.get(use)
        if held is None:
            held = self._held[use] = ls.create_renderer(config, self._device, progress=self._progress, compiles=False)
        elif held.config != config:
            held.reconfigure(config)
            _return_freed_memory()
        return held

    def has(self, use: Hashable, config: ls.RenderConfig) -> bool:
        """Whether a use has a renderer with settings already."""
        held = self._held.get(use)
        return held is not None and held.config == config

    def close(self) -> None:
        """Forgets all of them."""
        self._held.clear()
        _noise_log.removeFilter(self._is_from_other_thread)

    def retain_only(self, uses: Collection[Hashable]) -> None:
        """Frees the renderers of all other uses."""
        if gone := self._held.keys() - set(uses):
            for use in gone:
                self.drop(use)
            _return_freed_memory()

    def drop(self, use: Hashable) -> None:
        """Frees the renderer of a use."""
        self._held.pop(use, None)

    def _is_from_other_thread(self, record: logging.LogRecord) -> bool:
        """Whether a line about grain is worth a log: that the first of many samples is grainy is not."""
        return record.threadName != THREAD


def _return_freed_memory() -> None:
    """Returns to the system what renderers have freed: glibc keeps blocks of up to 32 MiB, of other sizes each time."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has this
        ctypes.CDLL(None).malloc_trim(0)


_log = logging.getLogger("lumisplat")

_MOVING, _AT_REST, _BEFORE = "moving", "at rest", "before"
"""Uses of renderers; frames in real time have one of each page."""


@dataclass(frozen=True)
class _Job:
    """A frame to render."""

    page: Page
    key: tuple[int, int]
    pose: Pose
    state: State
    before: State
    """What a split picture shows to the left."""
    options: Options
    moves: bool
    """Whether the view moves; else it is at rest."""


class RenderLoop:
    """Renders for all pages, in one thread.

    Args:
        session: What to show.
        device: Where to render.
        progress: Told when kernels are compiled.
        on_frame: Called after each frame with its page, its step, None at rest, and its milliseconds.
        overlay: Draws on pictures, such as lines that show where lights are.
        on_levels: Told how much is done of the levels of a capture, 0..1.
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
        """When a view that moves was drawn last, seconds of the monotonic clock."""
        self._levels = Levels(self._wake, on_levels, self._is_busy)
        self.scenes = SceneBuilder(self._levels, device, progress, session.report)
        """Makes the scenes of frames; for the thread of the loop alone."""
        self._scenes_before = SceneBuilder(self._levels, device, progress, session.report)
        self._pages: list[Page] = []
        self._background: deque[Generator[None]] = deque()
        self._background_waited = False
        """Whether a view at rest had the last turn, while there was an errand."""
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name=THREAD, daemon=True)

    def start(self) -> None:
        """Starts to render."""
        self._thread.start()

    def add(self, page: Page) -> None:
        """Renders for a page, too."""
        with self._session.changed:
            if page.is_open:  # else it went before it was here
                self._pages.append(page)
            self._session.changed.notify_all()

    def remove(self, page: Page) -> None:
        """Renders no longer for a page."""
        with self._session.changed:
            if page in self._pages:
                self._pages.remove(page)
            self._renderers.drop(page)
        page.close()

    def run_in_background(self, steps: Generator[None]) -> None:
        """Does something long, such as a video: a step of it each time that no view moves, in turns with views at rest.

        Args:
            steps: Its steps. Whatever it raises is reported, and ends it; it is closed if the loop ends before it.
        """
        with self._session.changed:
            self._background.append(steps)
            self._session.changed.notify_all()

    def thumbnail(self, camera: ls.Camera, show: Callable[[Picture], object]) -> None:
        """Renders a small image of the scene when no view moves, with the renderer of views at rest.

        Args:
            camera: From where, of the size of the image.
            show: Gets the image, in the thread of the frames.
        """

        def work() -> Generator[None]:
            state = self._session.state
            config = frame_config(state.config, "color")
            if config.pipeline.is_sequence:  # whose first frame is noisy
                config = replace(config, pipeline=ls.Pipeline.HYBRID, samples=1)
            scene = self.scenes.of(state.document, config, self._session.options.time, 0, waits=False)
            frame = self._renderers.of(_AT_REST, config).render(scene, camera)
            show(frame_image(frame, "color"))
            yield

        self.run_in_background(work())

    def must_yield(self) -> bool:
        """Whether a long frame has to give way: a view moves, or the viewer is to end. Any thread may ask."""
        revision = self._session.revision
        pages = [page for page in list(self._pages) if page.pose is not None]
        return not self._is_open or any(p.key != (revision, p.pose_number) and p.takes_frames for p in pages)

    def close(self) -> None:
        """Ends after the frame that is being rendered."""
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
        """Whether a view moves, or a page still waits for its first picture."""
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
            except ls.errors.StoppedError:  # it is drawn again when there is time
                pass
            except Exception as error:  # a frame that fails must not end the session
                self._give_up(job, error)
        for steps in self._background:
            steps.close()

    def _next_background_job(self, job: _Job | None) -> Generator[None] | None:
        """The errand whose turn it is; None: it is that of the job. The lock is held."""
        if not self._background or (job is not None and (job.moves or not self._background_waited)):
            self._background_waited = bool(self._background)
            return None
        self._background_waited = False
        return self._background[0]

    def _step(self, steps: Generator[None]) -> None:
        """Does the next step of an errand."""
        try:
            next(steps)
            return
        except StopIteration:
            pass
        except Exception as error:  # an errand that fails must not end the session
            self._report(error)
        self._background.popleft()

    def _give_up(self, job: _Job, error: Exception) -> None:
        """Leaves a page as it is until something changes, and says why."""
        with self._session.changed:
            job.page.key, job.page.is_finished = job.key, True
            self._session.changed.notify_all()
        self._report(error)

    def _report(self, error: Exception) -> None:
        """Says what went wrong, and logs where, unless it is a mistake of somebody's."""
        if not isinstance(error, ls.LumisplatError):
            _log.error("the viewer could not render a frame:\n%s", traceback.format_exc())
        self._session.report(" ".join(str(error).split()) or type(error).__name__)

    # --- What is next; the lock is held ---

    def _next_job(self) -> _Job | None:
        """A page whose view has changed, else one at rest that is not finished; None: nothing is to be done."""
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
        """The uses that may have a renderer while the state of a job is shown."""
        in_sequence = job.state.config.pipeline.is_sequence
        uses: list[Hashable] = [*self._pages] if in_sequence else [_MOVING, _AT_REST]
        return uses if job.options.split is None else [*uses, (_BEFORE, True), (_BEFORE, False)]

    def _move_to_back(self, page: Page) -> None:
        """Puts a page behind the others."""
        self._pages.remove(page)
        self._pages.append(page)

    def _time_to_rest(self) -> float | None:
        """Seconds until a view comes to rest; None: none will by itself."""
        waiting = [page.changed_at + SETTLED_S for page in self._pages if page.key is not None and not page.is_finished]
        return max(min(waiting) - time.monotonic(), 1e-3) if waiting else None

    # --- Frames ---

    def _develop(self, job: _Job) -> bool:
        """Shows the frame that the page has with another tone map, exposure or view, if nothing else has changed."""
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
        """A frame of a view that has changed, as fine as the budget allows."""
        page, state, options = job.page, job.state, job.options
        self._moved_at = time.monotonic()
        follows = state.config.pipeline.bounces_light  # its time goes with the pixels
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
        """The first full frame of a view at rest, or the next sample of it."""
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
        """What a page shows of a frame: beside what was before, if they are compared, and with lines and insets."""
        picture, share = frame_image(frame, job.options.view), job.options.split
        if share is not None:
            picture = split_image(self._before_image(job, frame.camera, level), picture, share)
        return self._overlay(picture, frame)

    def _before_image(self, job: _Job, camera: ls.Camera, level: int) -> Picture:
        """What the scene was before; at rest with as many samples, up to a few."""
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
    """What a frame is of, and not how it is developed."""
    undeveloped = replace(config, tone_map=ls.ToneMap.NONE)
    return job.state.document, job.pose, undeveloped, job.options.height, job.options.time


def _has_same_inputs(one: tuple[object, ...], other: tuple[object, ...]) -> bool:
    """Whether two frames are of the same: of one document, and of equal settings."""
    return one[0] is other[0] and one[1:] == other[1:]


def _ignore(label: str, fraction: float) -> None:
    """Progress that nobody sees: asking for it has the noise estimated."""


def _is_finished(frame: ls.Frame, rests: int, noise: float | None, config: ls.RenderConfig) -> bool:
    """Whether a page at rest needs no further frame after so many."""
    if config.pipeline.is_sequence:
        return rests >= REALTIME_FRAMES_AT_REST
    if frame.samples == 0:
        return True  # the sorted raster is exact
    if noise is not None and noise <= (config.noise or NOISE_AT_REST):
        return True
    return frame.samples >= (config.samples or SAMPLES_AT_REST)
