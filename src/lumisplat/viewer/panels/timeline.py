"""The time of an animation: a slider, and a thread that moves it on while it plays."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.viewer.state.session import Session
from lumisplat.viewer.thresholds import PLAY_STEPS_PER_S

if TYPE_CHECKING:
    import viser


class Timeline:
    """Controls of the time, hidden unless something moves, in the present folder.

    Args:
        gui: The pages' controls.
        session: Has the time.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._session = session
        self._time = gui.add_slider("time", 0.0, 1.0, 0.001, 0.0, visible=False, hint="Seconds.")
        self._plays = gui.add_checkbox("play", False, visible=False)
        self._time.on_update(lambda event: self._go(float(self._time.value)) if event.client_id is not None else None)
        self._plays.on_update(lambda _: self._wake.set())
        self._wake = threading.Event()
        self._is_open = True
        self._duration = 0.0
        self._thread = threading.Thread(target=self._play, name="lumisplat play", daemon=True)
        self._thread.start()

    def show(self, animation: ls.Animation | None) -> None:
        """Shows the time of an animation; None: nothing moves."""
        self._duration = 0.0 if animation is None else animation.duration
        self._time.visible = self._plays.visible = animation is not None
        if animation is not None:
            self._time.max = max(self._duration, 1e-3)

    def close(self) -> None:
        """Ends the thread."""
        self._is_open = False
        self._wake.set()
        self._thread.join()

    def _go(self, seconds: float) -> None:
        self._session.set_options(time=seconds)

    def _play(self) -> None:
        """While it plays, the time goes on as fast as that of a clock, and begins again at its end."""
        while self._is_open:
            if not self._plays.value or self._duration <= 0.0:
                self._wake.wait()
                self._wake.clear()
                continue
            started, first = time.monotonic(), self._session.options.time
            while self._is_open and self._plays.value:
                now = (first + time.monotonic() - started) % self._duration
                self._time.value = now
                self._go(now)
                time.sleep(1.0 / PLAY_STEPS_PER_S)
