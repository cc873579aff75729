"""Emulates CUDA graphs without a GPU: Warp also captures and replays on the CPU, so a stale graph fails there too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
