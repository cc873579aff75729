"""Times single kernels of frames, and counts the records that their rays load."""

import ctypes
import mmap
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import warp as wp

from lumisplat.runtime.launcher import Kernel, Launcher

_COUNTS_AT = 0x2000_0000_0000
"""Address of the counts, the same in each process, so that compiled kernels stay in the cache."""
_COUNTS = 8
_MAP_FIXED_NOREPLACE = 0x100000


class KernelLauncher(Launcher):
    """Launches GPUs' schedule, on a CPU too, without graphs, and times each kernel by waiting before and after it."""

    def __init__(self, device: str) -> None:
        super().__init__(device, threads=1, profile=True, parallel=True)
        self.kernel_ms: defaultdict[str, float] = defaultdict(float)
        """Milliseconds by kernel since the last `reset`: wall time on a GPU, CPU time of the process on a CPU."""
        self.launches: defaultdict[str, int] = defaultdict(int)
        self._kernel_clock = time.perf_counter if self.is_cuda else time.process_time

    def reset(self) -> None:
        """Forgets all times."""
        self.kernel_ms.clear()
        self.launches.clear()

    def run(self, kernel: Kernel, count: int, *inputs: object) -> None:
        """Launches a kernel, and times it."""
        self._time(kernel, lambda: super(KernelLauncher, self).run(kernel, count, *inputs))

    def run_blocks(self, kernel: Kernel, blocks: int, *inputs: object) -> None:
        """Launches a kernel over thread blocks, and times it."""
        self._time(kernel, lambda: super(KernelLauncher, self).run_blocks(kernel, blocks, *inputs))

    def _time(self, kernel: Any, launch: Callable[[], None]) -> None:
        self.synchronize()
        begun = self._kernel_clock()
        launch()
        self.synchronize()
        self.kernel_ms[kernel.key] += 1e3 * (self._kernel_clock() - begun)
        self.launches[kernel.key] += 1


def counted_load_of(struct_type: Any, slot: int) -> Any:
    """Builds a function as ``aligned_load_of`` does, for CPUs, that also counts its calls in a slot of `counts`."""

    @wp.func_native(f"++reinterpret_cast<long long*>({_COUNTS_AT}ull)[{slot}];\nitem = items.data[i];")
    def load_counted(
        items: wp.array[struct_type],  # pyright: ignore[reportInvalidTypeForm]
        i: int,
        item: wp.ref[struct_type],
    ): ...

    return load_counted


def counts() -> Any:
    """Returns this process's counts, an array of integers that compiled kernels increment; the first call maps it."""
    global _mapped  # noqa: PLW0603
    if _mapped is None:
        system = ctypes.CDLL(None, use_errno=True)
        system.mmap.restype = ctypes.c_void_p
        flags = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED_NOREPLACE
        access = mmap.PROT_READ | mmap.PROT_WRITE
        at = system.mmap(
            ctypes.c_void_p(_COUNTS_AT), ctypes.c_size_t(mmap.PAGESIZE), access, flags, -1, ctypes.c_long(0)
        )
        if at != _COUNTS_AT:
            raise OSError(ctypes.get_errno(), f"memory at {_COUNTS_AT:#x} is not free")
        _mapped = (ctypes.c_longlong * _COUNTS).from_address(_COUNTS_AT)
    return _mapped


_mapped: Any = None
