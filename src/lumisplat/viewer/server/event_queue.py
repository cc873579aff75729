"""Handles page events in the order in which they were sent; viser's own threads would reorder them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

Read = TypeVar("Read")

TYPING_PAUSE_S = 0.6
"""Time without a key press after which a typed value is applied, seconds."""


@dataclass(eq=False)
class _Queue:
    """Event queue of one server."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Lock that runs events one at a time, in order of arrival."""
    arrivals: int = 0
    """Number of events so far."""
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    """Event that is set at each arrival."""


_QUEUES: WeakKeyDictionary[asyncio.AbstractEventLoop, _Queue] = WeakKeyDictionary()


def queued_callback(
    read: Callable[[Any], Read | None], act: Callable[[Read], object], *, is_typed: bool = False
) -> Callable[[Any], Awaitable[None]]:
    """Returns a callback for viser that handles each event after all earlier events.

    Args:
        read: Extracts the data from an event at once, because the next message changes the values of controls. A result
            of None ignores the event.
        act: Handles the data, in a thread.
        is_typed: True for events sent at each key press. They are handled after a pause in typing, or when another
            event arrives.
    """
    newest = 0
    """Arrival number of this callback's newest event."""

    async def callback(event: Any) -> None:
        nonlocal newest
        what = read(event)
        if what is None:
            return
        queue = _QUEUES.setdefault(asyncio.get_running_loop(), _Queue())
        queue.arrivals += 1
        arrival = newest = queue.arrivals
        queue.arrived.set()
        async with queue.lock:
            if is_typed:
                await _wait_for_next_event(queue, arrival)
                if newest != arrival:
                    return
            await asyncio.to_thread(act, what)

    return callback


async def _wait_for_next_event(queue: _Queue, arrival: int) -> None:
    """Waits for the next event, at most `TYPING_PAUSE_S` seconds."""
    while queue.arrivals == arrival:
        queue.arrived.clear()
        try:
            await asyncio.wait_for(queue.arrived.wait(), TYPING_PAUSE_S)
        except TimeoutError:
            break


def value_callback(read: Callable[[Any], Read], act: Callable[[Read], object], *, is_typed: bool = False) -> Any:
    """Returns a callback for a control that handles each value set by a user, in order.

    Args:
        read: Converts the control's value to the argument of ``act``.
        act: Handles the converted value, in a thread.
        is_typed: True for a control that sends each key press, as in `queued_callback`.
    """

    def value_of(event: Any) -> Read | None:
        return None if event.client_id is None else read(event.target.value)  # None: the program set the value

    return queued_callback(value_of, act, is_typed=is_typed)


def press_callback(act: Callable[[Any], object]) -> Any:
    """Returns a callback for a button that runs after all earlier events.

    Args:
        act: Handles the event, in a thread.
    """
    return queued_callback(lambda event: event, act)
