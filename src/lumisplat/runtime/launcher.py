"""Runs work on a device: device choice, kernel launches, CPU bands, CUDA graphs, stage timers.

All kernels are launched here. A Warp launch on the CPU uses one thread but releases the GIL. A launch is therefore cut
into bands, which run on the calling thread and a thread pool; a band is a range of thread indices, called items. CPU
atomics are not atomic across threads, so each output element of a banded kernel is written by one item only. The
kernel's first parameter is ``start``, the first item of the band, and it works on item ``start + tid``.
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
from functools import partial
from typing import Any, TypeVar, cast

import warp as wp

from lumisplat.errors import ConfigError, DeviceError, StoppedError
from lumisplat.memory import usable_memory
from lumisplat.progress import Progress
from lumisplat.runtime.buffers import DeviceArray, grown_capacity
from lumisplat.runtime.kernel_cache import KernelModule, load_module, warp_module_of
from lumisplat.runtime.start import start_warp

_log = logging.getLogger("lumisplat")

# Warp prints its banner and a line for each module it loads on standard output, where they would mix with what a
# program writes. Programs that want them can set the level again after this import.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING

COMPILING_ANNOUNCED_S = 1.0
"""If loading modules takes longer than this, in seconds, a warning says that they are being compiled."""

THREADS_VARIABLE = "LUMISPLAT_THREADS"
"""Environment variable that limits the CPU threads of a process, for machines with other work."""

POOL_BYTES = 2**30
"""Memory in bytes that a GPU's pool retains when idle.

Otherwise, every frame that is not replayed from a graph would allocate the scratch space of sums and sorts anew:
about 16 bytes for each (tile, Gaussian) pair."""

Kernel = wp.Kernel | Callable[..., None]
"""A Warp kernel; type checkers see the Python function from which the kernel is made."""

Result = TypeVar("Result")

_CPU_BLOCKS = threading.Lock()
"""Lock around changes of `wp.config.enable_cpu_blocks`, which is a setting of the whole process."""


def resolve_device(name: str = "auto") -> str:
    """Returns the Warp device for ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` on this machine.

    Raises:
        DeviceError: The device does not exist; the message lists the available ones.
    """
    start_warp()
    available = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
    if name == "auto":
        return available[1] if len(available) > 1 else "cpu"
    wanted = "cuda:0" if name == "cuda" else name
    if wanted not in available:
        raise DeviceError(f"there is no device '{name}' on this machine: use auto or one of {', '.join(available)}")
    return wanted


def retain_pool(device: str) -> None:
    """Makes a GPU's memory pool retain `POOL_BYTES` of freed memory, unless the program already retains more."""
    pool: Any = wp.get_device(device)
    if pool.is_mempool_enabled and wp.get_mempool_release_threshold(device) < POOL_BYTES:
        wp.set_mempool_release_threshold(device, POOL_BYTES)


def usable_cores() -> int:
    """Returns the number of CPU cores that this process may use; LUMISPLAT_THREADS overrides it.

    Raises:
        ConfigError: The environment variable is not a whole number from 1.
    """
    given = os.environ.get(THREADS_VARIABLE)
    if given is not None:
        if not given.isascii() or not given.isdigit() or int(given) == 0:
            raise ConfigError(f"{THREADS_VARIABLE} is '{given}', expected a whole number from 1")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def block_threads(compiled: Any) -> int:
    """Returns the CUDA threads per block that a kernel, or a Warp module, is compiled for."""
    return getattr(compiled, "module", compiled).options["block_dim"]


@contextmanager
def _joined(jobs: list[Future[None]]) -> Generator[None]:
    """Cancels pending jobs on exit and waits for the running ones, also after an error or interrupt."""
    try:
        yield
    finally:
        for job in jobs:
            job.cancel()
        wait(jobs)


@contextmanager
def _blocks_on_cpus() -> Generator[None]:
    """Lets CPUs run thread blocks as fibers of one thread: slow, used by tests of kernels made for CUDA."""
    with _CPU_BLOCKS:
        before, wp.config.enable_cpu_blocks = wp.config.enable_cpu_blocks, True
        try:
            yield
        finally:
            wp.config.enable_cpu_blocks = before


@dataclass(slots=True)
class _Replayed:
    """Result of work that `Launcher.replay` has run, and its CUDA graph once it is captured."""

    key: object
    graph: wp.Graph | None = None
    result: object = None
    """Value that the work returned when its CUDA graph was captured."""


class Launcher:
    """Launches kernels on one device.

    Args:
        device: Device name as for ``resolve_device``.
        threads: CPU threads; None: as many as this process may use.
        profile: Time each stage on CUDA too, which costs a synchronisation per stage and disables graphs.
        parallel: True: schedule work as for CUDA, with one item per pixel or pair; False: one item per tile or chunk.
            None: True on CUDA only. Both schedules give the same results, so that the CPU can verify what CUDA runs.
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
        """Time of each stage of the last frame in milliseconds, in execution order."""
        self.clock = time.perf_counter
        """Clock of the stage times in seconds: wall time by default; ``time.process_time`` on shared machines."""
        self._pass = ""
        self._stop: Callable[[], bool] | None = None
        """Function that is called before each band (range of threads) of a CPU launch; when it returns True, the
        launch stops."""
        self._pool = ThreadPoolExecutor(cores)
        self._graphs: dict[str, _Replayed] = {}
        self.is_recording = False
        """True while `replay` records a CUDA graph: nothing runs yet, so counts must not be read back."""
        self._loaded: dict[int, KernelModule] = {}
        """Loaded modules by ``id``; the reference to the module keeps the id from being reused."""
        self._launched: set[object] = set()
        """Modules whose kernels have been launched on the CPU."""
        if self.is_cuda:
            retain_pool(self.device)

    def capacity_of(self, ends: DeviceArray, most: int | None = None) -> int:
        """Returns the capacity to allocate for a list whose length a kernel has just computed; 0 if the list is empty.

        The CPU reads the length from its own memory. The parallel schedule does not wait for a GPU to finish: it
        returns the largest possible length instead, and kernels skip elements beyond the actual length.

        Args:
            ends: Inclusive prefix sums of flags (0 or 1); the last one is the length of the list.
            most: Upper bound of the capacity; None: the number of flags.
        """
        most = len(ends) if most is None else min(most, len(ends))
        return most if self.is_parallel else grown_capacity(min(int(ends[-1:].numpy()[0]), most))

    def load(self, modules: Sequence[KernelModule], progress: Progress | None = None) -> None:
        """Loads those of the kernel modules that are not loaded yet, on all threads; compiles those not shipped.

        Compilation on first use on a machine takes seconds and is announced by a warning; compiled modules are cached
        on disk. Warp's compilers release the GIL. The label of the progress counts the modules.
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
                    progress(f"{label}, {len(missing) - len(loading)} of {len(missing)} modules", 0.0)
            for done, job in enumerate(as_completed(jobs), start=1):
                job.result()
                if progress:
                    progress(f"{label}, {done} of {len(missing)} modules", done / len(missing))
        self._loaded |= {id(module): module for module in missing}

    def run(self, kernel: Kernel, count: int, *inputs: object) -> None:
        """Launches ``kernel`` once with ``count`` thread indices; ``inputs`` are the kernel's parameters."""
        if count:
            self._load_before_launch(kernel)
            wp.launch(  # pyright: ignore[reportUnknownMemberType]
                kernel, dim=count, inputs=inputs, device=self.device, block_dim=self._threads_of(kernel)
            )

    def run_blocks(self, kernel: Kernel, blocks: int, *inputs: object) -> None:
        """Runs ``blocks`` thread blocks, whose threads share memory and synchronise.

        Args:
            kernel: Kernel of a Warp module whose name ends in ``blocks``, and whose option ``block_dim`` is the number
                of threads; its ``wp.tid()`` is the block and the thread.
            blocks: Number of blocks.
            *inputs: Parameters of the kernel.
        """
        if blocks:
            threads = block_threads(kernel)
            with _blocks_on_cpus():
                wp.launch(  # pyright: ignore[reportUnknownMemberType]
                    kernel, dim=(blocks, threads), inputs=inputs, device=self.device, block_dim=threads
                )

    def run_banded(self, kernel: Kernel, count: int, *inputs: object, bands: int | None = None) -> None:
        """Runs ``kernel(start, *inputs)`` for ``count`` thread indices; on the CPU, in ranges (bands) on all threads.

        Args:
            kernel: Kernel that writes each output element from one thread index; its first parameter is the first index
                of the band.
            count: Number of thread indices.
            *inputs: Other parameters of the kernel.
            bands: Number of bands; more bands balance uneven work better. None: one per thread.
        """
        if not self.is_cuda:
            self._raise_if_stopped()
        bands = min(bands or self.threads, count)
        if bands < 2 or (self.threads == 1 and self._stop is None):
            self.run(kernel, count, 0, *inputs)
            return
        self._load_before_launch(kernel)
        edges = [count * band // bands for band in range(bands + 1)]
        pending = iter(list(itertools.pairwise(edges)))

        def run_bands() -> None:
            launch: Any = None
            try:
                for start, end in pending:
                    self._raise_if_stopped()
                    launch = self._run_band(launch, kernel, start, end, inputs)
            finally:
                for _ in pending:  # drains the queue, so that no band starts after an error
                    pass

        # This thread takes bands, too, because waking another one takes longer.
        jobs = [self._pool.submit(run_bands) for _ in range(min(self.threads, bands) - 1)]
        # Wait for running bands even after an interrupt: they still write to arrays.
        with _joined(jobs):
            run_bands()
            for job in jobs:
                job.result()

    def _load_before_launch(self, kernel: Kernel) -> None:
        """Loads a kernel's module on the CPU, unless it has been launched.

        Warp would load it, but compile it even if it is shipped; and of threads that launch a module, one would replace
        what another runs.
        """
        module: Any = getattr(kernel, "module", None)
        if not self.is_cuda and module is not None and module not in self._launched:
            self._load(module)
            self._launched.add(module)

    def _run_band(self, launch: Any, kernel: Kernel, start: int, end: int, inputs: Sequence[object]) -> Any:
        """Runs the thread indices from ``start`` to ``end`` of a kernel on this thread; returns the recorded launch.

        ``launch`` is the recorded launch of the thread's previous band; None for the first band. Only its range is
        changed, because packing all parameters again would take longer than running many of the bands.
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
        """Makes banded CPU launches stoppable; GPU launches end in milliseconds, and graphs must run as a whole.

        Args:
            stop: Called before each band, by any thread; once it returns True, `StoppedError` is raised. None: never.
        """
        self._stop = stop
        try:
            yield
        finally:
            self._stop = None

    def _raise_if_stopped(self) -> None:
        if self._stop is not None and self._stop():
            raise StoppedError("the frame was stopped by its caller")

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Times the ``with`` block under ``name``; on CUDA only when profiling, because timing waits for the device.

        The time of a stage does not include the stages within it.
        """
        name = f"{self._pass}: {name}" if self._pass else name
        with self._timed(name):
            yield

    @contextmanager
    def frame_pass(self, name: str) -> Generator[None]:
        """Times a pass of a frame under ``name``, and the stages within it under ``name: stage``."""
        outer, self._pass = self._pass, name
        try:
            with self._timed(name):
                yield
        finally:
            self._pass = outer

    @contextmanager
    def _timed(self, name: str) -> Generator[None]:
        """Adds the time of the ``with`` block, minus that of timed blocks within it, to the time of ``name``."""
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
        """Runs ``work`` and returns its result; on CUDA as a graph, which is captured anew when ``key`` changes.

        ``work`` must only launch kernels, without allocation or readback. Values that change between calls, including
        those that ``work`` returns, must be stored in arrays, because each replay returns the values from the capture.
        The first call with a key runs the work directly, which allocates and compiles; the second call captures the
        graph.
        """
        if not self.can_capture:
            return work()
        replayed = self._graphs.get(name)
        if replayed is None or replayed.key != key:
            self._graphs.pop(name, None)  # frees the old result before the work allocates
            result = work()
            self._graphs[name] = _Replayed(key)
            return result
        if replayed.graph is None:
            with self._recording(), wp.ScopedCapture(device=self.device) as capture:
                replayed.result = work()
            replayed.graph = capture.graph
        wp.capture_launch(replayed.graph)  # pyright: ignore[reportArgumentType]
        return cast(Result, replayed.result)

    @contextmanager
    def _recording(self) -> Generator[None]:
        self.is_recording = True
        try:
            yield
        finally:
            self.is_recording = False

    def drop_graphs(self) -> None:
        """Frees all graphs and their return values."""
        self._graphs.clear()

    @property
    def can_capture(self) -> bool:
        """True if repeated work is captured as CUDA graphs: on CUDA, unless stages are timed one by one.

        Capturing also needs memory pools, because sums and sorts allocate scratch space. Some virtual GPUs and the
        Windows Subsystem for Linux have no pools.
        """
        device: Any = wp.get_device(self.device)
        return self.is_cuda and not self.profile and bool(device.is_mempool_enabled)

    def _threads_of(self, kernel: Kernel) -> int:
        """Returns the block size for launching a kernel whose threads are independent; 1 on the CPU."""
        return block_threads(kernel) if self.is_cuda else 1

    def _load(self, module: KernelModule) -> None:
        """Compiles and loads a module for the block size (threads per block) with which its kernels are launched."""
        warp_module = warp_module_of(module)
        has_blocks = warp_module.name.endswith("blocks")
        threads = block_threads(warp_module) if has_blocks or self.is_cuda else 1
        with _blocks_on_cpus() if has_blocks else nullcontext():
            load_module(module, self.device, threads)

    @property
    def free_memory(self) -> int:
        """Device memory in bytes that is free."""
        device: Any = wp.get_device(self.device)
        return int(device.free_memory) if device.is_cuda else usable_memory() or 0

    def mark(self) -> Callable[[], None]:
        """Returns a function that waits until the device has run all that was launched before this call."""
        device: Any = wp.get_device(self.device)
        if device.is_cpu:
            return lambda: None
        return partial(cast(Any, wp).synchronize_event, device.stream.record_event())

    def synchronize(self) -> None:
        """Waits until the device is idle."""
        wp.synchronize_device(self.device)
