"""Runs work on a device: device choice, kernel launches, CPU bands, CUDA graphs, stage timers. The only launch site.

A Warp CPU launch is single-threaded but releases the GIL, so one launch is cut into bands over the calling thread and a
thread pool. CPU atomics are not atomic across threads: a banded kernel writes each output element from one item only.
Every kernel that may be banded takes ``start`` first and works on item ``start + tid``.
"""

from __future__ import annotations

import itertools
import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, as_completed, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import warp as wp

from lumisplat.errors import ConfigError, DeviceError, StoppedError
from lumisplat.progress import Progress
from lumisplat.runtime.buffers import DeviceArray, grown_capacity
from lumisplat.runtime.kernel_cache import KernelModule, load_module, warp_module_of
from lumisplat.runtime.start import start_warp

_log = logging.getLogger("lumisplat")

# Warp prints its banner and a line for each module it loads on standard output, where they would mix with what a
# program writes. Whoever wants them sets the level again, after this import.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING

COMPILING_ANNOUNCED_S = 1.0
"""Kernels that take longer than this to load, seconds, are being compiled, which is announced."""

THREADS_VARIABLE = "LUMISPLAT_THREADS"
"""Environment variable that says how many CPU threads a process may use, where others work beside it."""

SCRATCH_BYTES_KEPT = 2**30
"""Memory of its pool that a GPU does not take back when it is idle, bytes: otherwise the scratch space of sums and
sorts, about 16 bytes for each (tile, Gaussian) pair, is got anew in every frame that is not replayed from a graph."""

Kernel = wp.Kernel | Callable[..., None]
"""A Warp kernel, which type checkers take for the function that it is made of."""

Result = TypeVar("Result")

_CPU_BLOCKS = threading.Lock()
"""Held while `wp.config.enable_cpu_blocks`, a setting of the whole process, is changed."""


def resolve_device(name: str = "auto") -> str:
    """The Warp device that ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` means on this machine.

    Raises:
        DeviceError: There is no such device; the message lists the available ones.
    """
    start_warp()
    available = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
    if name == "auto":
        return available[1] if len(available) > 1 else "cpu"
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in available:
        raise DeviceError(f"no device '{name}' here: use auto or one of {', '.join(available)}")
    return wanted


def keep_scratch(device: str) -> None:
    """Lets the memory pool of a GPU keep what frames allocate and free; a program that lets it keep more is obeyed."""
    pool: Any = wp.get_device(device)
    if pool.is_mempool_enabled and wp.get_mempool_release_threshold(device) < SCRATCH_BYTES_KEPT:
        wp.set_mempool_release_threshold(device, SCRATCH_BYTES_KEPT)


def usable_cores() -> int:
    """CPU cores this process may run on, or as many as the environment variable LUMISPLAT_THREADS says.

    Raises:
        ConfigError: That is no number from 1.
    """
    given = os.environ.get(THREADS_VARIABLE)
    if given is not None:
        if not given.isascii() or not given.isdigit() or int(given) == 0:
            raise ConfigError(f"{THREADS_VARIABLE} is '{given}', expected a whole number from 1")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def block_threads(compiled: Any) -> int:
    """CUDA threads of the blocks that a kernel, or a module of Warp, is compiled for."""
    return getattr(compiled, "module", compiled).options["block_dim"]


@contextmanager
def _joined(jobs: list[Future[None]]) -> Generator[None]:
    """Ends when no job is running, also after an error or an interrupt; jobs not yet started are cancelled."""
    try:
        yield
    finally:
        for job in jobs:
            job.cancel()
        wait(jobs)


@contextmanager
def _blocks_on_cpus() -> Generator[None]:
    """Lets CPUs run blocks of threads, as fibers of one thread: slowly, for tests of what CUDA runs."""
    with _CPU_BLOCKS:
        before, wp.config.enable_cpu_blocks = wp.config.enable_cpu_blocks, True
        try:
            yield
        finally:
            wp.config.enable_cpu_blocks = before


@dataclass(slots=True)
class _Replayed:
    """Work that has run with a key, and its graph once it has been captured."""

    key: object
    graph: wp.Graph | None = None
    result: object = None
    """What the work returned when it was captured."""


class Launcher:
    """Launches kernels on one device.

    Args:
        device: As for ``resolve_device``.
        threads: CPU threads; None: as many as this process may use.
        profile: Time each stage on CUDA too, which costs a synchronisation per stage and disables graphs.
        parallel: Schedule work as for CUDA, an item a pixel or a pair, instead of an item a tile or a chunk; None: on
            CUDA only. The results are the same, so the CPU can check what CUDA runs.
    """

    def __init__(
        self, device: str = "auto", threads: int | None = None, profile: bool = False, parallel: bool | None = None
    ) -> None:
        if threads is not None and threads < 1:
            raise ConfigError(f"threads is {threads}, expected at least 1, or None for as many as there are cores")
        self.device = resolve_device(device)
        self.is_cuda = self.device.startswith("cuda")
        self.is_parallel = self.is_cuda if parallel is None else parallel
        cores = threads or usable_cores()
        self.threads = 1 if self.is_cuda else cores
        self.profile = profile
        self.stage_ms: dict[str, float] = {}
        """Time of each stage of the last frame, milliseconds, in the order they ran."""
        self.clock = time.perf_counter
        """What times them, seconds: wall time, or where others use the machine, too, ``time.process_time``."""
        self._pass = ""
        self._stop: Callable[[], bool] | None = None
        """Asked before each band."""
        self._pool = ThreadPoolExecutor(cores)
        self._graphs: dict[str, _Replayed] = {}
        self._loaded: dict[int, KernelModule] = {}
        """Modules by their identity, which keeps them."""
        self._banded: set[object] = set()
        """Modules whose kernels have run in bands."""
        if self.is_cuda:
            keep_scratch(self.device)

    def room(self, ends: DeviceArray, most: int | None = None) -> int:
        """Returns a capacity for the elements of a list whose length the device has just computed; 0 if it is empty.

        The CPU reads the length from its own memory. The parallel schedule does not wait for a GPU: it makes room for
        as many elements as there may be, and kernels skip those that do not exist.

        Args:
            ends: Inclusive sums of flags that are 0 or 1; the last one is the length.
            most: Elements of the list beyond these are not used; None: there may be one for each flag.
        """
        most = len(ends) if most is None else min(most, len(ends))
        return most if self.is_parallel else grown_capacity(min(int(ends[-1:].numpy()[0]), most))

    def load(self, modules: Sequence[KernelModule], progress: Progress | None = None) -> None:
        """Compiles and loads those of the kernel modules that are not yet, as many at once as there are threads.

        Takes seconds at their first use on a machine, which one log line announces, so that nobody waits unknowingly;
        they are then cached on disk. Warp's compilers release the GIL.
        """
        missing = [module for key, module in {id(one): one for one in modules}.items() if key not in self._loaded]
        if not missing:
            return
        label = "loading kernels"
        if progress:
            progress(label, 0.0)
        jobs = [self._pool.submit(self._load, module) for module in missing]
        with _joined(jobs):
            loading = wait(jobs, COMPILING_ANNOUNCED_S, FIRST_EXCEPTION).not_done
            if loading:
                label = "compiling kernels (once)"
                _log.warning("%s: this takes up to a minute", label)
                if progress:
                    progress(label, 0.0)
            for done, job in enumerate(as_completed(jobs), start=1):
                job.result()
                if progress:
                    progress(label, done / len(missing))
        self._loaded |= {id(module): module for module in missing}

    def run(self, kernel: Kernel, count: int, *inputs: object) -> None:
        """Runs ``count`` items of ``kernel`` in one launch."""
        if count:
            wp.launch(  # pyright: ignore[reportUnknownMemberType]
                kernel, dim=count, inputs=inputs, device=self.device, block_dim=self._threads_of(kernel)
            )

    def run_blocks(self, kernel: Kernel, blocks: int, *inputs: object) -> None:
        """Runs ``blocks`` blocks of threads that share memory and wait for each other.

        Args:
            kernel: Of a Warp module whose name ends in ``blocks``, and whose option ``block_dim`` is the
                number of threads; its ``wp.tid()`` is the block and the thread.
            blocks: Number of blocks.
            *inputs: The kernel's parameters.
        """
        if blocks:
            threads = block_threads(kernel)
            with _blocks_on_cpus():
                wp.launch(  # pyright: ignore[reportUnknownMemberType]
                    kernel, dim=(blocks, threads), inputs=inputs, device=self.device, block_dim=threads
                )

    def run_banded(self, kernel: Kernel, count: int, *inputs: object, bands: int | None = None) -> None:
        """Runs ``count`` items of ``kernel(start, *inputs)``, on the CPU in bands over all threads.

        Args:
            kernel: Write-once kernel whose first parameter is the first item of the band.
            count: Number of items.
            *inputs: The kernel's other parameters.
            bands: Number of bands; more of them balance uneven work better. None: one a thread.
        """
        if not self.is_cuda:
            self._stop_if_asked()
        bands = min(bands or self.threads, count)
        if self.threads == 1 or bands < 2:
            self.run(kernel, count, 0, *inputs)
            return
        self._load_for_bands(kernel)
        edges = [count * band // bands for band in range(bands + 1)]
        pending = iter(list(itertools.pairwise(edges)))

        def run_bands() -> None:
            launch: Any = None
            try:
                for start, end in pending:
                    self._stop_if_asked()
                    launch = self._run_band(launch, kernel, start, end, inputs)
            finally:
                for _ in pending:  # after an error, no further band starts
                    pass

        # This thread works, too: another one would have to wake up first.
        jobs = [self._pool.submit(run_bands) for _ in range(min(self.threads, bands) - 1)]
        # After an interrupt, the arrays that bands still write to must outlive them.
        with _joined(jobs):
            run_bands()
            for job in jobs:
                job.result()

    def _load_for_bands(self, kernel: Kernel) -> None:
        """Loads the module of a kernel, once, before several threads do: one might run what another one replaces."""
        module: Any = getattr(kernel, "module", None)
        if module is not None and module not in self._banded:
            self._load(module)
            self._banded.add(module)

    def _run_band(self, launch: Any, kernel: Kernel, start: int, end: int, inputs: Sequence[object]) -> Any:
        """Runs one band by the launch of the thread's last one, if there was one; returns its launch.

        To pack all parameters anew would take longer than many a band.
        """
        if launch is None:
            launch = wp.launch(  # pyright: ignore[reportUnknownMemberType]
                kernel,
                dim=end - start,
                inputs=(start, *inputs),
                device=self.device,
                block_dim=self._threads_of(kernel),
                record_cmd=True,
            )
        else:
            launch.set_dim(end - start)
            launch.set_param_at_index(0, start)
        launch.launch()
        return launch

    @contextmanager
    def stoppable(self, stop: Callable[[], bool] | None) -> Generator[None]:
        """Lets banded launches on CPUs be given up; GPUs finish theirs in milliseconds, and graphs must be whole.

        Args:
            stop: Asked before each band, by any thread; once it is True, `StoppedError` is raised. None: nothing stops.
        """
        self._stop = stop
        try:
            yield
        finally:
            self._stop = None

    def _stop_if_asked(self) -> None:
        if self._stop is not None and self._stop():
            raise StoppedError("the frame was given up, as the caller has asked")

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Times a block of work under ``name``; on CUDA only when profiling, as it has to wait for the device.

        The time of inner stages is not part of the outer one's.
        """
        name = f"{self._pass}: {name}" if self._pass else name
        with self._timed(name):
            yield

    @contextmanager
    def frame_pass(self, name: str) -> Generator[None]:
        """Times a pass of a frame under ``name``, and the stages in it under ``name: stage``."""
        outer, self._pass = self._pass, name
        try:
            with self._timed(name):
                yield
        finally:
            self._pass = outer

    @contextmanager
    def _timed(self, name: str) -> Generator[None]:
        """Adds the time of a block of work, without those inside it, to that of ``name``."""
        timed = not self.is_cuda or self.profile
        started, before = self.clock(), sum(self.stage_ms.values())
        try:
            yield
        finally:
            if timed:
                if self.is_cuda:
                    self.synchronize()
                elapsed = 1e3 * (self.clock() - started) - (sum(self.stage_ms.values()) - before)
                self.stage_ms[name] = self.stage_ms.get(name, 0.0) + elapsed

    def replay(self, name: str, key: object, work: Callable[[], Result]) -> Result:
        """Runs ``work`` and returns its result; on CUDA as a graph, captured anew when ``key`` changes.

        ``work`` must only launch: no allocation, no readback, and values that change between calls must be in arrays.
        So must what it returns: a graph returns what its capture has returned. The first call with a key runs the work
        directly, which allocates and compiles; the second captures.
        """
        if not self.can_capture:
            return work()
        held = self._graphs.get(name)
        if held is None or held.key != key:
            self._graphs.pop(name, None)  # what its result holds is freed before the work allocates
            result = work()
            self._graphs[name] = _Replayed(key)
            return result
        if held.graph is None:
            with wp.ScopedCapture(device=self.device) as capture:
                held.result = work()
            held.graph = capture.graph
        wp.capture_launch(held.graph)  # pyright: ignore[reportArgumentType]
        return cast(Result, held.result)

    def drop_graphs(self) -> None:
        """Frees all graphs, and what their work has returned."""
        self._graphs.clear()

    @property
    def can_capture(self) -> bool:
        """Whether repeated work becomes graphs: on CUDA, unless stages are timed one by one.

        Sums and sorts allocate scratch space while they are captured, for which the device needs memory pools: some
        virtual GPUs, and Windows' subsystem for Linux, have none.
        """
        device: Any = wp.get_device(self.device)
        return self.is_cuda and not self.profile and bool(device.is_mempool_enabled)

    def _threads_of(self, kernel: Kernel) -> int:
        """Threads of a block whose items do not know each other."""
        return block_threads(kernel) if self.is_cuda else 1

    def _load(self, module: KernelModule) -> None:
        """Compiles and loads a module for blocks as large as those that it is launched in."""
        warp_module = warp_module_of(module)
        has_blocks = warp_module.name.endswith("blocks")
        threads = block_threads(warp_module) if has_blocks or self.is_cuda else 1
        with _blocks_on_cpus() if has_blocks else nullcontext():
            load_module(module, self.device, threads)

    def synchronize(self) -> None:
        """Waits until the device is idle."""
        wp.synchronize_device(self.device)
