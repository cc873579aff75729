"""Runs the callbacks of page events in the order in which events were sent; viser's thread pool would reorder them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

Read = TypeVar("Read")

TYPING_PAUSE_S = 0.6
"""Time since the last key press after which the text of a text box is applied, seconds."""


@dataclass(eq=False)
class _Queue:
    """Orders the events of one viser server, whose asyncio loop owns the queue."""

    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Lock that a callback holds while it handles its event, so that events run one at a time in order of arrival."""
    arrivals: int = 0
    """Number of events that have arrived; the newest event has this number."""
    arrived: asyncio.Event = field(default_factory=asyncio.Event)
    """Flag that is set when an event arrives and wakes `_wait_for_next_event`."""
    acting: asyncio.Future[object] | None = None
    """The event that a thread handles, or that one handled last."""


_QUEUES: WeakKeyDictionary[asyncio.AbstractEventLoop, _Queue] = WeakKeyDictionary()


def queued_callback(
    read: Callable[[Any], Read | None], act: Callable[[Read], object], *, is_typed: bool = False
) -> Callable[[Any], Awaitable[None]]:
    """Returns an event callback for viser; its events are handled one at a time, after all earlier events.

    Args:
        read: Extracts the data from an event when it arrives, because later messages change the values of controls. If
            the result is None, the event is ignored.
        act: Handles the data in a worker thread when the event's turn comes.
        is_typed: True for a text control that sends an event at each key press: only the newest text is handled, after
            a pause of `TYPING_PAUSE_S` or when another event arrives.
    """
    newest = 0
    """Arrival number of the last event of this callback; an older text event with ``is_typed`` is skipped."""

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
            queue.acting = asyncio.ensure_future(asyncio.to_thread(act, what))
            await asyncio.shield(queue.acting)  # a thread cannot be cancelled

    return callback


async def finish_event(timeout: float) -> None:
    """Waits for the event that a thread handles in the running loop's queue, at most ``timeout`` seconds."""
    queue = _QUEUES.get(asyncio.get_running_loop())
    if queue is not None and queue.acting is not None:
        await asyncio.wait([queue.acting], timeout=timeout)


async def _wait_for_next_event(queue: _Queue, arrival: int) -> None:
    """Waits until an event has arrived after event number ``arrival``, at most `TYPING_PAUSE_S` seconds."""
    while queue.arrivals == arrival:
        queue.arrived.clear()
        try:
            await asyncio.wait_for(queue.arrived.wait(), TYPING_PAUSE_S)
        except TimeoutError:
            break


def value_callback(read: Callable[[Any], Read], act: Callable[[Read], object], *, is_typed: bool = False) -> Any:
    """Returns a callback for a control: each value that a user sets is handled in order of arrival.

    Args:
        read: Converts the control's value to the argument of ``act``.
        act: Handles the converted value, in a thread.
        is_typed: True for a text control that sends an event at each key press, as in `queued_callback`.
    """

    def value_of(event: Any) -> Read | None:
        return None if event.client_id is None else read(event.target.value)  # None: the program set the value

    return queued_callback(value_of, act, is_typed=is_typed)


def press_callback(act: Callable[[Any], object]) -> Any:
    """Returns a callback for a button; a press is handled after all events that arrived before it.

    Args:
        act: Handles the event, in a thread.
    """
    return queued_callback(lambda event: event, act)
