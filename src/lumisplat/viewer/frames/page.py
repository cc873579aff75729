"""State of one open page: camera, level of detail, frames, and the screen that displays them."""

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
    LEVEL_FRACTIONS,
    MOVING_GAUSSIANS_MAX,
    PIXEL_SCALES,
)

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class DetailStep:
    """Level of detail and resolution of a frame."""

    level: int
    """Level of detail, an index into `LEVEL_FRACTIONS`."""
    scale: float
    """Resolution scale, one of `PIXEL_SCALES`."""


_LAST = len(LEVEL_FRACTIONS) - 1

GAUSSIAN_STEPS = (
    DetailStep(0, 1.0),
    DetailStep(1, 1.0),
    *(DetailStep(1, scale) for scale in PIXEL_SCALES[1:-1]),
    *(DetailStep(level, PIXEL_SCALES[-2]) for level in range(2, _LAST + 1)),
    DetailStep(_LAST, PIXEL_SCALES[-1]),
)
"""Detail steps for frames whose time depends on the Gaussian count. A quarter of the Gaussians is three times faster;
half the pixels saves a sixth of the time."""

PIXEL_STEPS = tuple(DetailStep(0, scale) for scale in PIXEL_SCALES)
"""Detail steps for frames whose time depends on the ray count, or that reuse earlier frames."""


def first_step(count: int) -> int:
    """Returns the index into `GAUSSIAN_STEPS` for the first frame of a scene with ``count`` Gaussians."""
    level = next((n for n in range(1, _LAST) if count * LEVEL_FRACTIONS[n] <= MOVING_GAUSSIANS_MAX), _LAST)
    return next(number for number, step in enumerate(GAUSSIAN_STEPS) if step.level == level)


class DetailController:
    """Chooses the detail step of the next frame from the times of earlier frames.

    Args:
        steps: Steps from finest to coarsest.
        first: Index of the first step.
    """

    def __init__(self, steps: tuple[DetailStep, ...] = GAUSSIAN_STEPS, first: int = 1) -> None:
        self.steps, self._index = steps, first
        self._recent_ms: dict[int, float] = {}
        """Recent frame time of each step, milliseconds."""
        self._frames_held = 0

    @property
    def step(self) -> DetailStep:
        """Detail step of the next frame."""
        return self.steps[self._index]

    def record(self, milliseconds: float, budget: float) -> None:
        """Records the time of a frame and chooses the next step.

        Args:
            milliseconds: Time of the frame.
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
"""Grey level behind transparent frames, 0 to 255."""


@dataclass(frozen=True)
class ScreenImage:
    """Image to display next on a page."""

    picture: Picture
    """sRGB image, shape (H, W, 3), uint8."""
    quality: int
    """JPEG quality, 1 to 95."""
    depth: npt.NDArray[np.float32] | None = None
    """View depth of every `DEPTH_STRIDE`-th pixel, page units; None for a moving view."""


def frame_image(frame: ls.Frame, view: str) -> Picture:
    """Returns a view of a frame as an sRGB image of shape (H, W, 3), uint8.

    Args:
        frame: The frame.
        view: ``color`` or one of `lumisplat.Frame.VIEWS`.

    Raises:
        ConfigError: The frame was rendered without the AOV that the view needs.
    """
    if view != "color":
        return (255.0 * frame.view(view) + 0.5).astype(np.uint8)
    pixels = np.asarray(frame, np.uint8)
    if pixels.shape[2] == 3:
        return pixels
    share = pixels[..., 3:].astype(np.uint16)
    return ((pixels[..., :3] * share + _BACKGROUND_GRAY * (255 - share) + 127) // 255).astype(np.uint8)


def page_depth(frame: ls.Frame, page_from_scene: float) -> npt.NDArray[np.float32]:
    """Returns the view depth of a frame at every `DEPTH_STRIDE`-th pixel, page units, to occlude gizmos on the page."""
    half = DEPTH_STRIDE // 2
    depth = frame.depth_z[half::DEPTH_STRIDE, half::DEPTH_STRIDE] * page_from_scene
    return np.nan_to_num(depth, nan=1e3, posinf=1e3).astype(np.float32)


def split_image(before: Picture, after: Picture, share: float) -> Picture:
    """Joins two images of one size: ``before`` fills the left fraction ``share``, with a white line at the border."""
    column = min(max(round(share * after.shape[1]), 0), after.shape[1] - 1)
    joined = after.copy()
    joined[:, :column] = before[:, :column]
    joined[:, column] = 255
    return joined


class Screen(Protocol):
    """Display for a page's images: a browser page or a notebook cell."""

    def show(self, shown: ScreenImage) -> None:
        """Sends an image and waits until it is displayed or a timeout ends the wait."""
        ...

    def close(self) -> None:
        """Ends a wait in `show`, from another thread."""
        ...


class Page:
    """An open page, with a thread that sends images to its screen.

    The thread sends the newest image after the screen has displayed the last one, so that no queue builds up.

    Args:
        screen: Screen that displays the images.
        changed: Condition whose lock guards the page's state; the page notifies it of changes.
    """

    def __init__(self, screen: Screen, changed: threading.Condition) -> None:
        self._screen, self._changed = screen, changed
        self.pose: Pose | None = None
        """Camera of the page; None if the page is not visible and gets no frames."""
        self.pose_number = 0
        self.fitted_aspects: set[float] = set()
        """Aspect ratios for which the viewer placed the camera so that the whole scene fits."""
        self.changed_at = 0.0
        """Time of the last change of the view, seconds of the monotonic clock."""
        self.key: tuple[int, int] | None = None
        """Session revision and pose number of the last frame, rendered or failed."""
        self.detail = DetailController()
        self.frame: ls.Frame | None = None
        """Frame that the page displays."""
        self.content: tuple[object, ...] | None = None
        """Inputs that determine the displayed frame, except exposure and tone map; None before a frame."""
        self.before_image: Picture | None = None
        """Image of the left side of the comparison."""
        self.before_image_key: object = None
        """View and size for which `before_image` was rendered."""
        self.is_finished = False
        """True if a still view needs no further samples."""
        self.noise: float | None = None
        self.frames_at_rest = 0
        self.is_open = True
        self._waiting: ScreenImage | None = None
        self._is_sending = False
        self._thread = threading.Thread(target=self._send, name="lumisplat page", daemon=True)
        self._thread.start()

    def set_pose(self, pose: Pose | None) -> None:
        """Sets the camera; None stops rendering for the page."""
        with self._changed:
            if pose != self.pose:
                self.pose = pose
                self.pose_number += 1
                self._changed.notify_all()

    @property
    def takes_frames(self) -> bool:
        """True if no image waits to be sent, so that a new image would be displayed next."""
        return self.is_open and self._waiting is None

    @property
    def is_at_rest(self) -> bool:
        """True if the page has displayed and acknowledged the finished image of a still view."""
        with self._changed:
            return self.is_finished and self._waiting is None and not self._is_sending

    def show(self, shown: ScreenImage) -> None:
        """Queues an image to send next, replacing one that still waits."""
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
    """Sends images to a page of viser and waits for its acknowledgement.

    Args:
        client: Connection of the page.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._is_open = True
        self._has_answered = False
        self._answers = True

    def show(self, shown: ScreenImage) -> None:
        """Sends an image and waits until the page has received it."""
        self._client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=shown.quality, depth=shown.depth
        )
        self._client.flush()
        self._await_answer()

    def close(self) -> None:
        """Ends a wait in `show`."""
        self._is_open = False

    def _await_answer(self) -> None:
        """Waits until the page has processed its messages, by a request that viser pages answer in order."""
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
