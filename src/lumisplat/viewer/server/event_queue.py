"""Handles events of pages in the order in which they were sent: viser's threads overtake each other."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

Read = TypeVar("Read")

TYPING_PAUSE_S = 0.6
"""How long a value that is typed waits for the next key, seconds."""


@dataclass(eq=False)
class _Queue:
    """Those who ask for something, of one server."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Whoever waits for it longest is next."""
    arrivals: int = 0
    """How many have asked."""
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    """Set at each arrival."""


_QUEUES: WeakKeyDictionary[asyncio.AbstractEventLoop, _Queue] = WeakKeyDictionary()


def queued_callback(
    read: Callable[[Any], Read | None], act: Callable[[Read], object], *, is_typed: bool = False
) -> Callable[[Any], Awaitable[None]]:
    """A callback for events of viser, each of which is done when those before it are.

    Args:
        read: Takes from an event what is to be done, at once: the next message changes what handles say. None: nothing
            is.
        act: Does it, in a thread.
        is_typed: Whether it is asked for at each key: then it is done once no key has followed for a while, or
            something else is asked for.
    """
    newest = 0
    """The last of its arrivals."""

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
    """Waits for the next arrival, but not for long."""
    while queue.arrivals == arrival:
        queue.arrived.clear()
        try:
            await asyncio.wait_for(queue.arrived.wait(), TYPING_PAUSE_S)
        except TimeoutError:
            break


def value_callback(read: Callable[[Any], Read], act: Callable[[Read], object], *, is_typed: bool = False) -> Any:
    """A callback for a control: does something with each value that somebody has chosen on a page, in their order.

    Args:
        read: Makes what is to be passed on of the control's value.
        act: Does it, in a thread.
        is_typed: As of `queued_callback`.
    """

    def value_of(event: Any) -> Read | None:
        return None if event.client_id is None else read(event.target.value)  # else it was set from here

    return queued_callback(value_of, act, is_typed=is_typed)


def press_callback(act: Callable[[Any], object]) -> Any:
    """A callback for a button: does what it is for when all that was asked for before is done.

    Args:
        act: Does it, in a thread; it gets the event.
    """
    return queued_callback(lambda event: event, act)
