"""One open page: where it looks from, what it has been shown, and what it is sent next."""

from __future__ import annotations

import threading
from typing import Protocol

import lumisplat as ls
from lumisplat.viewer.frames.pace import Pace
from lumisplat.viewer.frames.picture import Picture, Shown
from lumisplat.viewer.frames.pose import Pose


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
