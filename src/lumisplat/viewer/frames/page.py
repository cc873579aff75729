"""One open page of the viewer: its camera, its last frame, and the thread that sends images to its screen."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.thresholds import (
    ANSWER_S,
    BUSY_ANSWER_S,
    DEPTH_STRIDE,
    DETAIL_HEADROOM,
    DETAIL_HOLD_FRAMES,
    DETAIL_TIME_DECAY,
    DIRECT_MS,
    GAP_DECAY,
    LEVEL_FRACTIONS,
    MOVING_GAUSSIANS_MAX,
    PIXEL_SCALES,
    SETTLED_GAPS,
    SETTLED_S,
)

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class DetailStep:
    """Quality of a moving view's frame: which level of detail of the captures, and at which resolution."""

    level: int
    """Level of detail of the captures, an index into `LEVEL_FRACTIONS`; 0 has all Gaussians."""
    scale: float
    """Width and height relative to a still view's frame, one of `PIXEL_SCALES`."""


_LAST = len(LEVEL_FRACTIONS) - 1

GAUSSIAN_STEPS = (
    DetailStep(0, 1.0),
    DetailStep(1, 1.0),
    *(DetailStep(1, scale) for scale in PIXEL_SCALES[1:-1]),
    *(DetailStep(level, PIXEL_SCALES[-2]) for level in range(2, _LAST + 1)),
    DetailStep(_LAST, PIXEL_SCALES[-1]),
)
"""Detail steps, finest first, for pipelines whose frame time depends mostly on the number of Gaussians. A quarter of
the Gaussians is three times faster; half the pixels saves only a sixth of the time, so Gaussians are reduced first."""

PIXEL_STEPS = tuple(DetailStep(0, scale) for scale in PIXEL_SCALES)
"""Detail steps, finest first, for pipelines that trace bounced light: only the resolution is reduced, because the
frame time depends on the number of rays."""


def first_step(count: int) -> int:
    """Returns the index into `GAUSSIAN_STEPS` for a moving view's first frame, before any frame time is known.

    Args:
        count: Number of Gaussians in the scene.
    """
    level = next((n for n in range(1, _LAST) if count * LEVEL_FRACTIONS[n] <= MOVING_GAUSSIANS_MAX), _LAST)
    return next(number for number, step in enumerate(GAUSSIAN_STEPS) if step.level == level)


class DetailController:
    """Chooses the detail of a moving view's next frame, so that frame times stay within a budget.

    Args:
        steps: Detail steps from finest to coarsest.
        first: Index into ``steps`` for the first frame.
    """

    def __init__(self, steps: tuple[DetailStep, ...] = GAUSSIAN_STEPS, first: int = 1) -> None:
        self.steps, self._index = steps, first
        self._recent_ms: dict[int, float] = {}
        """Smoothed frame time of each step that has been used, milliseconds, by index into ``steps``."""
        self._frames_held = 0

    @property
    def step(self) -> DetailStep:
        """Level of detail and resolution with which to render the next frame of a moving view."""
        return self.steps[self._index]

    def record(self, milliseconds: float, budget: float) -> None:
        """Records the time of a frame and chooses the step of the next one.

        A frame over budget selects a coarser step at once; a finer step follows only after `DETAIL_HOLD_FRAMES` frames.

        Args:
            milliseconds: Time of the frame that was rendered with the current step.
            budget: Time budget of a frame, milliseconds.
        """
        known = self._recent_ms.get(self._index, milliseconds)
        self._recent_ms[self._index] = 0.5 * (known + milliseconds)
        self._frames_held += 1
        excess = min(milliseconds, known) / budget
        if excess > 1.0 and self._index + 1 < len(self.steps):
            self._move(min(self._index + 1 + int(math.log2(excess)), len(self.steps) - 1))
        elif self._index > 0 and self._frames_held >= DETAIL_HOLD_FRAMES:
            finer = self._recent_ms.get(self._index - 1, 2.0 * self._recent_ms[self._index])
            if finer < DETAIL_HEADROOM * budget:
                self._move(self._index - 1)
            else:  # the step may have become faster, by another view or less load
                self._recent_ms[self._index - 1] = DETAIL_TIME_DECAY * finer

    def _move(self, to: int) -> None:
        self._index, self._frames_held = to, 0


Picture = npt.NDArray[np.uint8]

_BACKGROUND_GRAY = 32
"""sRGB grey level, 0 to 255, that pages show behind transparent parts of a frame."""


@dataclass(frozen=True)
class ScreenImage:
    """Image that waits to be sent to a page, with its JPEG quality and the depth that occludes gizmos."""

    picture: Picture
    """sRGB image, shape (H, W, 3), uint8."""
    quality: int
    """JPEG quality, 1 to 95."""
    depth: npt.NDArray[np.float32] | None = None
    """View depth at every `DEPTH_STRIDE`-th pixel of each axis, page units; None for a moving view."""


def frame_image(frame: ls.Frame, view: str) -> Picture:
    """Returns what a page shows of a frame, its colour or a false-colour AOV: sRGB, shape (H, W, 3), uint8.

    Args:
        frame: The frame.
        view: One of `lumisplat.viewer.session.VIEWS`.

    Raises:
        ConfigError: The frame was rendered without the AOV that the view needs.
    """
    if view in ls.Frame.VIEWS:
        return (255.0 * frame.view(view) + 0.5).astype(np.uint8)
    pixels = np.asarray(frame, np.uint8)
    if pixels.shape[2] == 3:
        return pixels
    share = pixels[..., 3:].astype(np.uint16)
    return ((pixels[..., :3] * share + _BACKGROUND_GRAY * (255 - share) + 127) // 255).astype(np.uint8)


def page_depth(frame: ls.Frame, page_from_scene: float) -> npt.NDArray[np.float32]:
    """Returns a frame's view depth at every `DEPTH_STRIDE`-th pixel, page units; 1000 where no surface is."""
    half = DEPTH_STRIDE // 2
    depth = frame.depth_z[half::DEPTH_STRIDE, half::DEPTH_STRIDE] * page_from_scene
    return np.nan_to_num(depth, nan=1e3, posinf=1e3).astype(np.float32)


def split_image(before: Picture, after: Picture, share: float) -> Picture:
    """Joins two images of one size: ``before`` fills the left fraction ``share``, ``after`` the rest; white border."""
    column = min(max(round(share * after.shape[1]), 0), after.shape[1] - 1)
    joined = after.copy()
    joined[:, :column] = before[:, :column]
    joined[:, column] = 255
    return joined


class Screen(Protocol):
    """Interface of whatever displays a page's images: a `BrowserScreen`, or a `CellScreen` in a notebook."""

    def show(self, shown: ScreenImage) -> None:
        """Sends an image and waits until the display acknowledges it, or until a timeout."""
        ...

    def close(self) -> None:
        """Makes a `show` that waits in another thread return."""
        ...


class Page:
    """Camera and frames of one open page, with a thread that sends its images to a screen.

    The thread sends only the newest image, and only after the screen has displayed the last one; older ones are
    dropped.

    Args:
        screen: Screen that displays the images.
        changed: Condition of the session, whose lock guards the page's fields; the page notifies it when it has sent.
    """

    def __init__(self, screen: Screen, changed: threading.Condition) -> None:
        self._screen, self._changed = screen, changed
        self.pose: Pose | None = None
        """Camera of the page; None before the page has reported one, and while a notebook cell is hidden: no frames
        then."""
        self.pose_number = 0
        self.fitted_aspects: set[float] = set()
        """Aspect ratios, width over height, for which the viewer has moved the camera so that the whole scene fits."""
        self.rests_at = 0.0
        """Time from which the view counts as still unless it changes before, seconds of the monotonic clock."""
        self._pose_at = -math.inf
        """Time of the last change of ``pose``, seconds of the monotonic clock."""
        self._pose_gap = SETTLED_S
        """Largest recent time between two changes of ``pose``, at most `SETTLED_S`, seconds."""
        self._has_stopped = False
        """True if the page has said that its camera has stopped, and ``pose`` has not changed since."""
        self.full_ms = math.inf
        """Time of the page's last full frame, milliseconds; infinite before the first."""
        self.key: tuple[int, int] | None = None
        """`Session.revision` and the page's ``pose_number`` for the last frame, rendered or failed; a different pair
        means that a new frame is due. None before the first frame."""
        self.detail = DetailController()
        self.frame: ls.Frame | None = None
        """Last rendered frame of the page; None before the first."""
        self.content: tuple[object, ...] | None = None
        """Document, camera, settings, height and time of the last frame; None before the first. If a change leaves
        them equal, only exposure or tone map have changed, and the frame is developed again instead of rendered."""
        self.before_image: Picture | None = None
        """Last image of the earlier state that option *compare* shows on the left; None before one was rendered."""
        self.before_image_key: object = None
        """Frame key, motion, level of detail and size for which `before_image` was rendered; other values need a new
        image."""
        self.is_finished = False
        """True if the view is still and its frame has enough samples."""
        self.noise: float | None = None
        self.frames_at_rest = 0
        self.is_open = True
        self._waiting: ScreenImage | None = None
        self._is_sending = False
        self._thread = threading.Thread(target=self._send, name="lumisplat page", daemon=True)
        self._thread.start()

    def set_pose(self, pose: Pose | None) -> None:
        """Sets the camera that frames of the page are rendered from; None stops rendering for the page."""
        with self._changed:
            if pose != self.pose:
                now = time.monotonic()
                self._pose_gap = min(max(now - self._pose_at, GAP_DECAY * self._pose_gap), SETTLED_S)
                self.pose, self._pose_at, self._has_stopped = pose, now, False
                self.pose_number += 1
                self._changed.notify_all()

    def stop(self) -> None:
        """Ends the camera's motion, so that the page's next frame is a full one; a new pose begins another motion."""
        with self._changed:
            self._has_stopped = True
            self.rests_at = min(self.rests_at, self.stops_at)
            self._changed.notify_all()

    @property
    def stops_at(self) -> float:
        """Time from which the camera counts as stopped unless it moves before, seconds of the monotonic clock."""
        return self._pose_at + (0.0 if self._has_stopped else SETTLED_GAPS * self._pose_gap)

    def skips_reduced(self, revision: int) -> bool:
        """True if the next frame of a changed view is a full one: the camera has stopped, and full frames are fast.

        Args:
            revision: `Session.revision`; if it is not that of the last frame, the scene has changed, too.
        """
        only_camera_moved = self.key is not None and self.key[0] == revision
        return only_camera_moved and self._has_stopped and self.full_ms <= DIRECT_MS

    @property
    def takes_frames(self) -> bool:
        """True if the page is open and no image is queued, so that a new image would be sent next."""
        return self.is_open and self._waiting is None

    @property
    def is_at_rest(self) -> bool:
        """True if the view is still, its frame has enough samples, and the screen has displayed it."""
        with self._changed:
            return self.is_finished and self._waiting is None and not self._is_sending

    def show(self, shown: ScreenImage) -> None:
        """Queues an image for the screen; it replaces an image that has not been sent yet."""
        with self._changed:
            self._waiting = shown
            self._changed.notify_all()

    def close(self) -> None:
        """Closes the page and ends its thread."""
        with self._changed:
            self.is_open = False
            self._changed.notify_all()
        self._screen.close()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or not self.is_open)
                if not self.is_open or self._waiting is None:
                    return
                shown, self._waiting, self._is_sending = self._waiting, None, True
                self._changed.notify_all()
            self._screen.show(shown)
            self._is_sending = False


_POLL_S = 0.2


class BrowserScreen:
    """Sends images to a browser page of viser, and waits until the page acknowledges each.

    Args:
        client: Connection of the page.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._is_open = True
        self._has_answered = False
        self._answers = True

    def show(self, shown: ScreenImage) -> None:
        """Sends an image and waits until the page acknowledges it, at most `BUSY_ANSWER_S` seconds."""
        self._client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=shown.quality, depth=shown.depth
        )
        self._client.flush()
        self._await_answer()

    def close(self) -> None:
        """Makes a `show` that waits in another thread return."""
        self._is_open = False

    def _await_answer(self) -> None:
        """Waits until the page answers a request, which it does only after it has displayed all images sent before."""
        until = time.monotonic() + (BUSY_ANSWER_S if self._has_answered else ANSWER_S)
        while self._answers and self._is_open:
            try:
                self._client.local_storage.get_item("frame", timeout=_POLL_S)
                self._has_answered = True
                return
            except TimeoutError:
                if time.monotonic() >= until:
                    self._answers = self._has_answered
                    return
            except RuntimeError:  # the page has closed, or has no storage, which counts as an answer
                return
