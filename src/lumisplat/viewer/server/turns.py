"""What pages ask for, done in the order in which they asked: viser's threads overtake each other."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar
from weakref import WeakKeyDictionary

Read = TypeVar("Read")

_TURNS: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Lock] = WeakKeyDictionary()
"""Of each server: whoever waits for it longest is next."""


def in_turn(read: Callable[[Any], Read], act: Callable[[Read], object]) -> Callable[[Any], Awaitable[None]]:
    """A callback for events of viser, each of which is done when those before it are.

    Args:
        read: Takes from an event what is to be done, at once: the next message changes what handles say.
        act: Does it, in a thread.
    """

    async def callback(event: Any) -> None:
        what = read(event)
        async with _TURNS.setdefault(asyncio.get_running_loop(), asyncio.Lock()):
            await asyncio.to_thread(act, what)

    return callback
