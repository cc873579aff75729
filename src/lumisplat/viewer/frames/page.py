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
    DEPTH_STRIDE,
    GAUSSIANS_AT_ONCE,
    LEVEL_FRACTIONS,
    PACE_FORGETS,
    PACE_HEADROOM,
    PACE_HOLD,
    PATIENCE_S,
    PIXEL_SCALES,
)

if TYPE_CHECKING:
    import viser


@dataclass(frozen=True)
class Step:
    """How finely a frame is drawn."""

    level: int
    """Number of `LEVEL_FRACTIONS`."""
    scale: float
    """One of `PIXEL_SCALES`."""


_LAST = len(LEVEL_FRACTIONS) - 1

BY_GAUSSIANS = (
    Step(0, 1.0),
    Step(1, 1.0),
    *(Step(1, scale) for scale in PIXEL_SCALES[1:-1]),
    *(Step(level, PIXEL_SCALES[-2]) for level in range(2, _LAST + 1)),
    Step(_LAST, PIXEL_SCALES[-1]),
)
"""Of frames whose time goes with the Gaussians: a quarter of them is three times faster, half the pixels a sixth."""

BY_PIXELS = tuple(Step(0, scale) for scale in PIXEL_SCALES)
"""Of frames whose time goes with the rays, or that follow from those before them."""


def first_step(count: int) -> int:
    """The number of the step of `BY_GAUSSIANS` at which scenes of so many Gaussians begin: the second, as a rule."""
    level = next((n for n in range(1, _LAST) if count * LEVEL_FRACTIONS[n] <= GAUSSIANS_AT_ONCE), _LAST)
    return next(number for number, step in enumerate(BY_GAUSSIANS) if step.level == level)


class Pace:
    """Chooses steps by how long frames have taken.

    Args:
        steps: From the finest to the coarsest.
        first: The number of the first one.
    """

    def __init__(self, steps: tuple[Step, ...] = BY_GAUSSIANS, first: int = 1) -> None:
        self.steps, self._now = steps, first
        self._took: dict[int, float] = {}
        """Milliseconds of each step, lately."""
        self._held = 0

    @property
    def step(self) -> Step:
        """Of the next frame."""
        return self.steps[self._now]

    def took(self, milliseconds: float, budget: float) -> None:
        """Counts a frame of the present step, and chooses the next one.

        Args:
            milliseconds: What the frame has taken.
            budget: What a frame may take.
        """
        known = self._took.get(self._now, milliseconds)
        self._took[self._now] = 0.5 * (known + milliseconds)
        self._held += 1
        excess = min(milliseconds, known) / budget
        if excess > 1.0 and self._now + 1 < len(self.steps):
            self._move(min(self._now + 1 + int(math.log2(excess)), len(self.steps) - 1))
        elif self._now > 0 and self._held >= PACE_HOLD:
            finer = self._took.get(self._now - 1, 2.0 * self._took[self._now])
            if finer < PACE_HEADROOM * budget:
                self._move(self._now - 1)
            else:  # what once was slow may be quick now: another view, or fewer other programs
                self._took[self._now - 1] = PACE_FORGETS * finer

    def _move(self, to: int) -> None:
        self._now, self._held = to, 0


Picture = npt.NDArray[np.uint8]

_BEHIND = 32
"""Grey behind transparent frames."""


@dataclass(frozen=True)
class Shown:
    """What a page is to show next."""

    picture: Picture
    """(H, W, 3), sRGB."""
    quality: int
    """Of the JPEG."""
    depth: npt.NDArray[np.float32] | None = None
    """View depth in units of the page, of every `DEPTH_STRIDE`-th pixel; None: of a view that moves."""


def picture_of(frame: ls.Frame, view: str) -> Picture:
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
    return ((pixels[..., :3] * share + _BEHIND * (255 - share) + 127) // 255).astype(np.uint8)


def page_depth(frame: ls.Frame, page_from_scene: float) -> npt.NDArray[np.float32]:
    """Depth that a page hides its own handles behind."""
    half = DEPTH_STRIDE // 2
    depth = frame.depth_z[half::DEPTH_STRIDE, half::DEPTH_STRIDE] * page_from_scene
    return np.nan_to_num(depth, nan=1e3, posinf=1e3).astype(np.float32)


def split_picture(before: Picture, after: Picture, share: float) -> Picture:
    """Two pictures of one size as one: ``before`` in the left share of the width, and a line between them."""
    column = min(max(round(share * after.shape[1]), 0), after.shape[1] - 1)
    joined = after.copy()
    joined[:, :column] = before[:, :column]
    joined[:, column] = 255
    return joined


class Screen(Protocol):
    """Where pictures are seen: in a browser's page, or in a cell of a notebook."""

    def show(self, shown: Shown) -> None:
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
        self.framed: set[float] = set()
        """Aspects for which it was put where all of the scene is seen."""
        self.changed_at = 0.0
        """When what it should show changed last, seconds of the monotonic clock."""
        self.key: tuple[int, int] | None = None
        """Revision of the session and number of the pose that it is shown, or that could not be."""
        self.pace = Pace()
        self.frame: ls.Frame | None = None
        """What it shows."""
        self.content: tuple[object, ...] | None = None
        """What that is a frame of, however it is developed."""
        self.before: Picture | None = None
        """What the left part of a split picture shows."""
        self.before_key: object = None
        """Of which view and size that is."""
        self.is_finished = False
        """Whether it shows all that there is to show of a view at rest."""
        self.noise: float | None = None
        self.frames_at_rest = 0
        self.is_open = True
        self._waiting: Shown | None = None
        self._is_sending = False
        self._thread = threading.Thread(target=self._send, name="lumisplat page", daemon=True)
        self._thread.start()

    def look(self, pose: Pose | None) -> None:
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

    def show(self, shown: Shown) -> None:
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

    def show(self, shown: Shown) -> None:
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
        until = time.monotonic() + (PATIENCE_S if self._has_answered else ANSWER_S)
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
