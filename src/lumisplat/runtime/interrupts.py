"""Ctrl C while something is done that is not to end in its middle."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def interrupts_held() -> Generator[Callable[[], bool]]:
    """The first Ctrl C ends nothing: the function that is yielded says that it was pressed. The second one interrupts.

    Other threads than the main one, and programs with a handler of their own, keep theirs.
    """
    pressed = threading.Event()

    def hold(number: int, frame: object) -> None:
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    is_main = threading.current_thread() is threading.main_thread()
    # Others may have plans for it, and only the main thread may change them.
    holds = is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if holds:
        signal.signal(signal.SIGINT, hold)
    try:
        yield pressed.is_set
    finally:
        if holds:
            signal.signal(signal.SIGINT, signal.default_int_handler)
