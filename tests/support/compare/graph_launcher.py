"""Emulates CUDA graphs without a GPU: Warp also captures and replays on the CPU, so a stale graph fails there too."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import warp as wp

from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher, Result


class GraphLauncher(Launcher):
    """Runs the CUDA schedule on the CPU from captured graphs; addresses, sizes and values stay as captured."""

    draws = 0
    """Number of calls of ``replay`` so far."""
    launches = 0
    """Number of kernel launches outside replays so far, including those recorded during captures."""

    def __init__(self) -> None:
        super().__init__("cpu", threads=1, parallel=True)
        self.is_cuda = True  # all that CUDA does differently from here on is graphs, and not to time stages
        self._used: list[tuple[Any, ...]] = []

    @property
    def can_capture(self) -> bool:
        """True unless stages are timed, as on a GPU with memory pools."""
        return not self.profile

    def run(self, kernel: Any, count: int, *inputs: Any) -> None:
        """Launches a kernel, and keeps its inputs alive: a stale graph then reads old data instead of freed memory."""
        self._used.append(inputs)
        self.launches += 1
        super().run(kernel, count, *inputs)

    def run_blocks(self, kernel: Any, blocks: int, *inputs: object) -> None:
        """Launches a kernel over thread blocks, and keeps its inputs alive."""
        self._used.append(inputs)
        self.launches += 1
        super().run_blocks(kernel, blocks, *inputs)

    def replay(self, name: str, key: object, work: Callable[[], Result]) -> Result:
        """Replays a graph as on CUDA, and fails after 1000 calls, since a stale graph could be redrawn endlessly."""
        self.draws += 1
        assert self.draws < 1000, "is a frame drawn again from a stale graph, for ever?"
        return super().replay(name, key, work)

    @contextmanager
    def _recording(self) -> Generator[None]:
        """Fails if work that is recorded allocates, reads an array back, or copies from memory of the host.

        CUDA would refuse the first two. A graph would copy the last one again in each replay, from freed memory.
        """
        with (
            super()._recording(),
            patch.object(wp.array, "numpy", _refused("read back")),
            patch.object(Buffers, "_allocate", _refused("allocated")),
            patch.object(wp.array, "assign", _assigned_from_device),
        ):
            yield


def _refused(what: str) -> Callable[..., None]:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError(f"an array is {what} while a graph is recorded")

    return refuse


def _assigned_from_device(target: Any, source: Any) -> None:
    """Copies a device array to another; fails if the source is a NumPy array, or borrows memory of one."""
    owner = getattr(source, "deleter", None), getattr(source, "_ref", None)
    assert owner != (None, None), "memory of the host is copied while a graph is recorded"
    wp.copy(target, source)
