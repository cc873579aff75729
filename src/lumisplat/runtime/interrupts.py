"""Deferred Ctrl C, for work that must not stop halfway."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def deferred_interrupt() -> Generator[Callable[[], bool]]:
    """Makes the first Ctrl C in a ``with`` block only set a flag; yields a function that returns the flag.

    The caller must end the work when the flag is set. A second Ctrl C raises KeyboardInterrupt at once. The block
    changes nothing in other threads than the main thread, or if the program has set its own handler for Ctrl C.
    """
    pressed = threading.Event()

    def hold(number: int, frame: object) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    is_main = threading.current_thread() is threading.main_thread()
    # A program's own handler stays, and only the main thread may set handlers.
    holds = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if holds:
        signal.signal(signal.SIGINT, hold)
    try:
        yield pressed.is_set
    finally:
        if holds:
            signal.signal(signal.SIGINT, signal.default_int_handler)
