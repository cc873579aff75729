"""One open page: where it looks from, how finely it is drawn while it moves, its frames, and the browser."""

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
    """How finely a frame is drawn."""

    level: int
    """Number of `LEVEL_FRACTIONS`."""
    scale: float
    """One of `PIXEL_SCALES`."""


_LAST = len(LEVEL_FRACTIONS) - 1

GAUSSIAN_STEPS = (
    DetailStep(0, 1.0),
    DetailStep(1, 1.0),
    *(DetailStep(1, scale) for scale in PIXEL_SCALES[1:-1]),
    *(DetailStep(level, PIXEL_SCALES[-2]) for level in range(2, _LAST + 1)),
    DetailStep(_LAST, PIXEL_SCALES[-1]),
)
"""Of frames whose time goes with the Gaussians: a quarter of them is three times faster, half the pixels a sixth."""

PIXEL_STEPS = tuple(DetailStep(0, scale) for scale in PIXEL_SCALES)
"""Of frames whose time goes with the rays, or that follow from those before them."""


def first_step(count: int) -> int:
    """The number of the step of `GAUSSIAN_STEPS` at which scenes of so many Gaussians begin: the second, as a rule."""
    level = next((n for n in range(1, _LAST) if count * LEVEL_FRACTIONS[n] <= MOVING_GAUSSIANS_MAX), _LAST)
    return next(number for number, step in enumerate(GAUSSIAN_STEPS) if step.level == level)


class DetailController:
    """Chooses steps by how long frames have taken.

    Args:
        steps: From the finest to the coarsest.
        first: The number of the first one.
    """

    def __init__(self, steps: tuple[DetailStep, ...] = GAUSSIAN_STEPS, first: int = 1) -> None:
        self.steps, self._index = steps, first
        self._recent_ms: dict[int, float] = {}
        """Milliseconds of each step, lately."""
        self._frames_held = 0

    @property
    def step(self) -> DetailStep:
        """Of the next frame."""
        return self.steps[self._index]

    def record(self, milliseconds: float, budget: float) -> None:
        """Counts a frame of the present step, and chooses the next one.

        Args:
            milliseconds: What the frame has taken.
            budget: What a frame may take.
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
            else:  # what once was slow may be quick now: another view, or fewer other programs
                self._recent_ms[self._index - 1] = DETAIL_TIME_DECAY * finer

    def _move(self, to: int) -> None:
        self._index, self._frames_held = to, 0


Picture = npt.NDArray[np.uint8]

_BACKGROUND_GRAY = 32
"""Grey behind transparent frames."""


@dataclass(frozen=True)
class ScreenImage:
    """What a page is to show next."""

    picture: Picture
    """(H, W, 3), sRGB."""
    quality: int
    """Of the JPEG."""
    depth: npt.NDArray[np.float32] | None = None
    """View depth in units of the page, of every `DEPTH_STRIDE`-th pixel; None: of a view that moves."""


def frame_image(frame: ls.Frame, view: str) -> Picture:
    """The bytes of a frame.

    Args:
        frame: The frame.
        view: ``color``, or one of `lumisplat.Frame.VIEWS`.

    Raises:
        ConfigError: The frame was rendered without what the view needs.
    """
    if view != "color":
        return (255.0 * frame.view(view) + 0.5).astype(np.uint8)
    pixels = np.asarray(frame, np.uint8)
    if pixels.shape[2] == 3:
        return pixels
    share = pixels[..., 3:].astype(np.uint16)
    return ((pixels[..., :3] * share + _BACKGROUND_GRAY * (255 - share) + 127) // 255).astype(np.uint8)


def page_depth(frame: ls.Frame, page_from_scene: float) -> npt.NDArray[np.float32]:
    """Depth that a page hides its own handles behind."""
    half = DEPTH_STRIDE // 2
    depth = frame.depth_z[half::DEPTH_STRIDE, half::DEPTH_STRIDE] * page_from_scene
    return np.nan_to_num(depth, nan=1e3, posinf=1e3).astype(np.float32)


def split_image(before: Picture, after: Picture, share: float) -> Picture:
    """Two pictures of one size as one: ``before`` in the left share of the width, and a line between them."""
    column = min(max(round(share * after.shape[1]), 0), after.shape[1] - 1)
    joined = after.copy()
    joined[:, :column] = before[:, :column]
    joined[:, column] = 255
    return joined


class Screen(Protocol):
    """Where pictures are seen: in a browser's page, or in a cell of a notebook."""

    def show(self, shown: ScreenImage) -> None:
        """Sends a picture, and returns when it is there, or when there is no use in waiting any longer."""
        ...

    def close(self) -> None:
        """Ends the wait of `show`, from another thread."""
        ...


class Page:
    """A page and the thread that sends to it.

    Frames wait in a place for one: the next one is sent when the last one is there, so that no queue forms on the way.

    Args:
        screen: Where it is seen.
        changed: Held while what is known of the page changes, and notified.
    """

    def __init__(self, screen: Screen, changed: threading.Condition) -> None:
        self._screen, self._changed = screen, changed
        self.pose: Pose | None = None
        """Where it looks from; None: it is not to be seen, and has no frames."""
        self.pose_number = 0
        self.fitted_aspects: set[float] = set()
        """Aspects for which it was put where all of the scene is seen."""
        self.changed_at = 0.0
        """When what it should show changed last, seconds of the monotonic clock."""
        self.key: tuple[int, int] | None = None
        """Revision of the session and number of the pose that it is shown, or that could not be."""
        self.detail = DetailController()
        self.frame: ls.Frame | None = None
        """What it shows."""
        self.content: tuple[object, ...] | None = None
        """What that is a frame of, however it is developed."""
        self.before_image: Picture | None = None
        """What the left part of a split picture shows."""
        self.before_image_key: object = None
        """Of which view and size that is."""
        self.is_finished = False
        """Whether it shows all that there is to show of a view at rest."""
        self.noise: float | None = None
        self.frames_at_rest = 0
        self.is_open = True
        self._waiting: ScreenImage | None = None
        self._is_sending = False
        self._thread = threading.Thread(target=self._send, name="lumisplat page", daemon=True)
        self._thread.start()

    def set_pose(self, pose: Pose | None) -> None:
        """Looks from another place, or from none."""
        with self._changed:
            if pose != self.pose:
                self.pose = pose
                self.pose_number += 1
                self._changed.notify_all()

    @property
    def takes_frames(self) -> bool:
        """Whether a frame that is sent now is the next one that it shows."""
        return self.is_open and self._waiting is None

    @property
    def is_at_rest(self) -> bool:
        """Whether it has been sent all that there is to show, and has answered."""
        with self._changed:
            return self.is_finished and self._waiting is None and not self._is_sending

    def show(self, shown: ScreenImage) -> None:
        """Sends a picture as soon as the last one is there, in place of one that still waits."""
        with self._changed:
            self._waiting = shown
            self._changed.notify_all()

    def close(self) -> None:
        """Ends the thread; the page has gone, or is to go."""
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
    """Sends pictures to a page of viser, and asks whether they are there.

    Args:
        client: The page's connection.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._is_open = True
        self._has_answered = False
        self._answers = True

    def show(self, shown: ScreenImage) -> None:
        """Sends a picture, and waits for the page's answer."""
        self._client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=shown.quality, depth=shown.depth
        )
        self._client.flush()
        self._await_answer()

    def close(self) -> None:
        """Ends the wait."""
        self._is_open = False

    def _await_answer(self) -> None:
        """Waits until the page has taken what it was sent: it answers in order, and viser's pages answer this."""
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
            except RuntimeError:  # it has gone, or keeps nothing, which is an answer, too
                return
