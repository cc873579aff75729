"""What pages ask for, done in the order in which they asked: viser's threads overtake each other."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

Read = TypeVar("Read")

_TURNS: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Lock] = WeakKeyDictionary()
"""Of each server: whoever waits for it longest is next."""


def in_turn(read: Callable[[Any], Read | None], act: Callable[[Read], object]) -> Callable[[Any], Awaitable[None]]:
    """A callback for events of viser, each of which is done when those before it are.

    Args:
        read: Takes from an event what is to be done, at once: the next message changes what handles say. None: nothing
            is.
        act: Does it, in a thread.
    """

    async def callback(event: Any) -> None:
        what = read(event)
        if what is None:
            return
        async with _TURNS.setdefault(asyncio.get_running_loop(), asyncio.Lock()):
            await asyncio.to_thread(act, what)

    return callback


def chosen(read: Callable[[Any], Read], act: Callable[[Read], object]) -> Any:
    """A callback for a control: does something with each value that somebody has chosen on a page, in their order.

    Args:
        read: Makes what is to be passed on of the control's value.
        act: Does it, in a thread.
    """

    def value_of(event: Any) -> Read | None:
        return None if event.client_id is None else read(event.target.value)  # else it was set from here

    return in_turn(value_of, act)


def pressed(act: Callable[[Any], object]) -> Any:
    """A callback for a button: does what it is for when all that was asked for before is done.

    Args:
        act: Does it, in a thread; it gets the event.
    """
    return in_turn(lambda event: event, act)
