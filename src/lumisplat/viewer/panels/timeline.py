"""The time of an animation: a slider, and a thread that moves it on while it plays, and pages along the flight."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.viewer.server.turns import chosen
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.thresholds import PLAY_STEPS_PER_S

if TYPE_CHECKING:
    import viser


class Timeline:
    """Controls of the time, hidden unless something moves, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the time.
        fly: Moves all pages to a camera and what it looks at.
    """

    def __init__(self, gui: viser.GuiApi, session: Session, fly: Callable[[ls.Camera], None]) -> None:
        self._session, self._fly = session, fly
        self._time = gui.add_slider("time", 0.0, 1.0, 0.001, 0.0, visible=False, hint="Seconds.")
        self._plays = gui.add_checkbox("play", False, visible=False)
        hint = "Pages follow the camera path as time goes on."
        self._flies = gui.add_checkbox("fly along", False, visible=False, hint=hint)
        self._time.on_update(chosen(float, self._go))
        self._plays.on_update(lambda _: self._wake.set())
        self._animation: ls.Animation | None = None
        self._shown: tuple[object, ...] = ()
        """What the animation follows from, as it was seen last."""
        self._wake = threading.Event()
        self._is_open = True
        self._thread = threading.Thread(target=self._play, name="lumisplat play", daemon=True)
        self._thread.start()
        session.on_change(self._show)

    def toggle(self) -> None:
        """Plays, or stops."""
        self._plays.value = not self._plays.value
        self._wake.set()

    def close(self) -> None:
        """Ends the thread."""
        self._is_open = False
        self._wake.set()
        self._thread.join()

    def _show(self) -> None:
        """Shows the time of the animation, if there is one."""
        document = self._session.state.document
        shown = document.top, *(entry.actor for entry in document.entries if not entry.hidden)
        if len(shown) == len(self._shown) and all(a is b for a, b in zip(shown, self._shown, strict=True)):
            return
        self._shown, self._animation = shown, document.animation
        self._time.visible = self._plays.visible = self._animation is not None
        self._flies.visible = self._animation is not None and self._animation.camera_path is not None
        if self._animation is not None:
            self._time.max = max(self._animation.duration, 1e-3)
        self._wake.set()

    def _go(self, seconds: float) -> None:
        path = None if self._animation is None else self._animation.camera_path
        self._session.set_options(time=seconds)
        if path is not None and self._flies.value:
            self._fly(path.at(seconds))

    def _play(self) -> None:
        """While it plays, the time goes on as fast as that of a clock, and begins again at its end."""
        while self._is_open:
            animation = self._animation
            if not self._plays.value or animation is None:
                self._wake.wait()
                self._wake.clear()
                continue
            started, first = time.monotonic(), self._session.options.time
            while self._is_open and self._plays.value and self._animation is animation:
                now = (first + time.monotonic() - started) % animation.duration
                self._time.value = now
                self._go(now)
                time.sleep(1.0 / PLAY_STEPS_PER_S)
