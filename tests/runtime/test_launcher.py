"""Launches of kernels, ranges of threads, and buffers."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import Future, wait
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import warp as wp

from lumisplat.errors import ConfigError, DeviceError
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.raster import binning_kernels
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.runtime import launcher
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher, resolve_device
from support.kernels import package_modules


@pytest.mark.parametrize("count", [0, 1, 2, 3, 1000])
@pytest.mark.parametrize("bands", [None, 1, 7])
def test_thread_ranges_of_a_launch_cover_every_item_once(count: int, bands: int | None) -> None:
    """Each item runs exactly once, however a launch is cut into ranges."""
    order = wp.array(np.full(count, -1, np.int32), dtype=wp.int32, device="cpu")
    Launcher("cpu", threads=3).run_banded(binning_kernels.fill_identity, count, order, bands=bands)
    np.testing.assert_array_equal(order.numpy(), np.arange(count))


def test_times_of_a_stage_that_runs_twice_are_added_up() -> None:
    """A stage that runs twice is reported once, with the sum of its times."""
    launcher = Launcher("cpu")
    for _ in range(2):
        with launcher.stage("work"):
            pass
    assert list(launcher.stage_ms) == ["work"]
    assert launcher.stage_ms["work"] > 0.0


@pytest.mark.parametrize("name", ["cuda:99", "tpu", "", "cpu:1"])
def test_error_for_a_missing_device_lists_the_available_devices(name: str) -> None:
    """The name of the device is unknown, or its number does not exist."""
    with pytest.raises(DeviceError, match=r"use auto or one of cpu"):
        resolve_device(name)


@pytest.mark.parametrize("threads", [0, -1])
def test_launcher_with_zero_threads_is_refused(threads: int) -> None:
    """Zero threads do not mean all cores."""
    with pytest.raises(ConfigError, match="threads is"):
        Launcher("cpu", threads=threads)


@pytest.fixture
def joining(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Returns an event that is set once the launcher waits for its jobs, after it has cancelled pending ones."""
    event = threading.Event()

    def waited(jobs: Sequence[Future[None]], *how: Any) -> Any:
        if not how:
            event.set()
        return wait(jobs, *how)

    monkeypatch.setattr(launcher, "wait", waited)
    return event


def test_failed_kernel_launch_raises_its_error_only_after_all_threads_have_ended(joining: threading.Event) -> None:
    """When one range of items fails, no other starts, and none still writes to arrays once the error is raised."""
    started = threading.Event()
    begun: list[int] = []
    finished: list[int] = []

    class Failing(Launcher):
        def _run_band(self, launch: object, kernel: object, start: int, end: int, inputs: Sequence[object]) -> None:
            if threading.current_thread() is threading.main_thread():
                started.wait()
                raise KeyboardInterrupt
            begun.append(start)
            started.set()
            joining.wait()  # runs until the launcher waits for its jobs
            finished.append(start)

    try:
        with pytest.raises(KeyboardInterrupt):
            Failing("cpu", threads=2).run_banded(cast(Any, None), 20, bands=20)
        assert finished == begun, "none is still at work"
        assert len(begun) == 1, "no further band starts"
    finally:
        joining.set()


def test_buffers_grow_for_larger_requests_and_never_shrink() -> None:
    """Smaller requests reuse memory; only a larger one allocates."""
    buffers = Buffers("cpu")
    first = buffers.get("a", wp.float32, (4, 8))
    assert first.shape == (4, 8)
    assert buffers.get("a", wp.float32, 10).ptr == first.ptr
    assert buffers.allocations == 1
    buffers.get("a", wp.float32, 33)
    assert buffers.allocations == 2
    assert buffers.get("a", wp.float32, (4, 8)).shape == (4, 8)
    assert buffers.allocations == 2


def test_memory_limits_are_queried_before_large_allocations_and_not_before_small_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A frame allocates many small arrays, and reading the limits takes longer than rendering a small frame."""
    asked: list[None] = []
    monkeypatch.setattr("lumisplat.runtime.buffers.usable_memory", lambda: asked.append(None))
    buffers = Buffers("cpu")
    buffers.get("small", wp.float32, 2**18 - 1)
    assert not asked
    buffers.get("large", wp.float32, 2**18)
    assert len(asked) == 1


@pytest.mark.parametrize("size", [2**40, 2**55])
def test_out_of_memory_raises_an_error_that_names_device_and_buffer(size: int) -> None:
    """An impossible allocation raises the error before the system kills the process."""
    with pytest.raises(DeviceError, match=r"cpu.*'huge'"):
        Buffers("cpu").get("huge", wp.float64, size)


def test_time_of_nested_stages_is_not_counted_twice() -> None:
    """The outer stage gets the time outside its inner stages; the sum of all is the elapsed time."""
    launcher, now = Launcher("cpu"), [5.0]
    launcher.clock = lambda: now[0]
    with launcher.stage("outer"):
        now[0] += 0.003
        with launcher.stage("inner"):
            now[0] += 0.02
    assert launcher.stage_ms == pytest.approx({"outer": 3.0, "inner": 20.0})


def test_stage_that_runs_in_two_passes_has_a_separate_time_for_each():
    """A stage that runs in two passes has two times; time outside stages counts for the pass."""
    launcher, now = Launcher("cpu", threads=1), [5.0]
    launcher.clock = lambda: now[0]
    for name in ("first", "second"):
        with launcher.frame_pass(name), launcher.stage("work"):
            now[0] += 0.001
    with launcher.stage("work"):
        pass
    assert set(launcher.stage_ms) == {"first", "first: work", "second", "second: work", "work"}
    assert launcher.stage_ms["first: work"] == pytest.approx(1.0)


def test_no_cuda_graphs_are_captured_on_devices_without_memory_pools(monkeypatch: pytest.MonkeyPatch) -> None:
    """A device that cannot allocate during capture launches each kernel every time; frame three equals the first."""
    launcher, runs = Launcher("cpu"), []
    launcher.is_cuda = True
    monkeypatch.setattr(wp, "get_device", lambda _: SimpleNamespace(is_mempool_enabled=False))
    for number in range(4):
        launcher.replay("frame", "same", lambda number=number: runs.append(number))
    assert runs == [0, 1, 2, 3]


@pytest.mark.parametrize(("enabled", "before", "after"), [(True, 0, 2**30), (True, 2**31, 2**31), (False, 0, 0)])
def test_memory_pool_of_a_gpu_keeps_freed_scratch_memory_for_later_use(
    monkeypatch: pytest.MonkeyPatch, enabled: bool, before: int, after: int
) -> None:
    """The pool retains memory across waits, and never less than the program has set."""
    thresholds = {"cuda:0": before}
    monkeypatch.setattr(wp, "get_device", lambda _: SimpleNamespace(is_mempool_enabled=enabled))
    monkeypatch.setattr(wp, "get_mempool_release_threshold", thresholds.__getitem__)
    monkeypatch.setattr(wp, "set_mempool_release_threshold", thresholds.__setitem__)
    monkeypatch.setattr("lumisplat.runtime.launcher.resolve_device", lambda _: "cuda:0")
    Launcher("cuda")
    assert thresholds == {"cuda:0": after}


# --- Loading kernels ---


def test_loading_kernels_reports_progress_after_every_module() -> None:
    """The reported fraction and the count in the label grow module by module, on the thread of the caller."""
    heard: list[tuple[str, float, threading.Thread]] = []
    modules = [binning_kernels, camera_ray_kernels, film_kernels]
    Launcher("cpu", threads=2).load(modules, lambda *report: heard.append((*report, threading.current_thread())))
    assert [share for _, share, _ in heard] == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    assert [label.partition(", ")[2] for label, *_ in heard[1:]] == [f"{done} of 3 modules" for done in (1, 2, 3)]
    assert {thread for *_, thread in heard} == {threading.current_thread()}


@pytest.mark.parametrize("threads", [1, 2])
def test_error_of_a_kernel_compilation_is_raised_to_the_caller(
    threads: int, joining: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of one module is raised, and pending modules are not compiled."""
    loaded = []

    def load(module: str, **_: object) -> None:
        loaded.append(module)
        if module == "bad":
            raise RuntimeError("no such function")
        joining.wait()

    monkeypatch.setattr(wp, "load_module", load)
    with pytest.raises(RuntimeError, match="no such function"):
        Launcher("cpu", threads=threads).load(cast(Any, ["bad", *(f"good {i}" for i in range(100))]))
    assert len(loaded) <= 1 + threads


KERNELS = [module.name for module in package_modules()]


@pytest.mark.parametrize(
    "names",
    [
        pytest.param(["lumisplat.renderer.trace.camera_ray_kernels"], id="one"),
        pytest.param(KERNELS, id="all", marks=pytest.mark.deep),
    ],
)
def test_kernels_of_a_first_frame_compile_without_warnings(names: list[str], tmp_path: Path) -> None:
    """A first frame shows no compiler warnings."""
    program = (
        f"import importlib, warp as wp; wp.config.kernel_cache_dir = {str(tmp_path)!r}; wp.init();"
        "from lumisplat.runtime.launcher import Launcher; wp.config.log_level = wp.LOG_INFO;"
        f"[importlib.import_module(name.partition('_kernels')[0] + '_kernels') for name in {names!r}];"
        f"Launcher('cpu').load({names!r})"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "warning generated" not in done.stderr and "warnings generated" not in done.stderr
    assert done.stdout.count("(compiled)") == len(names)


def test_warp_prints_nothing_on_standard_output() -> None:
    """Neither Warp's banner nor its module lines appear, so that output of programs can be piped."""
    program = (
        "import lumisplat as ls; ls.create_renderer(device='cpu'); print('mine'); help(ls.render); "
        "assert callable(ls.render), 'a module hides the function'"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("mine\nHelp on function render in module lumisplat.renderer.one_shot")


def test_slow_kernel_compilation_is_announced_once_in_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Modules that load quickly are not announced."""
    said = threading.Event()
    monkeypatch.setattr(wp, "load_module", lambda *_, **__: None)
    monkeypatch.setattr("lumisplat.runtime.launcher.COMPILING_ANNOUNCED_S", 60.0)
    launcher = Launcher("cpu", threads=1)
    launcher.load([film_kernels])
    assert not caplog.messages
    monkeypatch.setattr(wp, "load_module", lambda *_, **__: said.wait())
    monkeypatch.setattr("lumisplat.runtime.launcher.COMPILING_ANNOUNCED_S", 0.0)
    monkeypatch.setattr(caplog.handler, "emit", lambda record, emit=caplog.handler.emit: (emit(record), said.set()))
    launcher.load([film_kernels, binning_kernels])
    assert caplog.messages == ["compiling kernels (once): this takes up to a minute"]
