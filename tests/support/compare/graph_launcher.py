"""CUDA graphs without a GPU: Warp captures and replays on the CPU as well, so a stale graph shows there too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from lumisplat.runtime.launcher import Launcher, Result


class GraphLauncher(Launcher):
    """Runs the CUDA schedule on the CPU, from captured graphs: addresses, sizes and values stay as captured."""

    draws = 0
    """Calls of ``replay`` so far."""
    launches = 0
    """Kernels that were launched one by one so far, also while a graph was captured."""

    def __init__(self) -> None:
        super().__init__("cpu", threads=1, parallel=True)
        self.is_cuda = True  # all that CUDA does differently from here on is graphs, and not to time stages
        self._used: list[tuple[Any, ...]] = []

    @property
    def can_capture(self) -> bool:
        """As on a GPU with memory pools."""
        return not self.profile

    def run(self, kernel: Any, count: int, *inputs: Any) -> None:
        """Keeps the inputs: a stale graph shows old data, where with freed memory it might end the process."""
        self._used.append(inputs)
        self.launches += 1
        super().run(kernel, count, *inputs)

    def run_blocks(self, kernel: Any, blocks: int, *inputs: object) -> None:
        """So does this."""
        self._used.append(inputs)
        self.launches += 1
        super().run_blocks(kernel, blocks, *inputs)

    def replay(self, name: str, key: object, work: Callable[[], Result]) -> Result:
        """As on CUDA; fails instead of drawing the same frame for ever."""
        self.draws += 1
        assert self.draws < 1000, "is a frame drawn again from a stale graph, for ever?"
        return super().replay(name, key, work)
