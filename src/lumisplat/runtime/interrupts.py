"""Ctrl C while something is done that is not to end in its middle."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def interrupts_held() -> Generator[Callable[[], bool]]:
    """Ctrl C, the first time, ends nothing that is being done, but is told by the function that it yields."""
    pressed = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield pressed.is_set
        return

    def hold(number: int, frame: object) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    before = signal.getsignal(signal.SIGINT)
    if before is not signal.default_int_handler:  # somebody else has plans for it
        yield pressed.is_set
        return
    signal.signal(signal.SIGINT, hold)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)
