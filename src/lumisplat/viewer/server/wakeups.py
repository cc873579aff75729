"""Messages to pages may come from any thread: viser's own way to wake whoever sends them fails at times."""

from __future__ import annotations

import asyncio
from dataclasses import field, make_dataclass
from functools import cache
from importlib import import_module
from typing import Any


class AnyThreadEvent(asyncio.Event):
    """An event that threads without its loop may set, if they then have the loop set it, too.

    viser sets its own so twice for each message; asyncio's goes through those who wait while the loop adds and removes
    some, and raises "deque mutated during iteration".
    """

    def set(self) -> None:
        """Says that it has happened; in the loop, wakes who waits."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            self._value = True
            return
        self._value = False  # otherwise nobody would be woken
        super().set()


@cache
def let_threads_push() -> None:
    """From now on, viser's buffers of messages take them from any thread."""
    infra: Any = import_module("viser.infra._infra")
    events = ("message_event", asyncio.Event, field(default_factory=AnyThreadEvent))
    infra.AsyncMessageBuffer = make_dataclass("AnyThreadBuffer", [events], bases=(infra.AsyncMessageBuffer,))
