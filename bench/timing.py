"""Chooses a benchmark's device, times its frames and their stages, and prints its tables."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import lumisplat as ls
from bench.presets import stage_ms


def parser(program: str, description: str | None) -> argparse.ArgumentParser:
    """Returns a parser with the option that all benchmarks have."""
    given = argparse.ArgumentParser(
        prog=f"python -m bench.{program}", description=description, formatter_class=argparse.RawTextHelpFormatter
    )
    given.add_argument("--device", type=device_here, default="cpu", help="auto, cpu, cuda or cuda:N (default: cpu)")
    return given


def device_here(name: str) -> str:
    """Returns the device that a name means on this machine."""
    from lumisplat.runtime.launcher import resolve_device

    try:
        return resolve_device(name)
    except ls.DeviceError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def quiet_warp() -> None:
    """Silences Warp, so that standard output has only results."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR


def print_head(first: str, *names: str) -> None:
    """Prints the first two lines of a Markdown table; all columns but the first hold numbers."""
    print(f"| {' | '.join((first, *names))} |\n| --- {'| ---: ' * len(names)}|", flush=True)


def print_row(*cells: object) -> None:
    """Prints a line of a Markdown table."""
    print(f"| {' | '.join(map(str, cells))} |", flush=True)


def clock_of(device: str) -> Callable[[], float]:
    """Returns the clock of a device, seconds: CPU time of all threads, or wall time on a GPU."""
    return time.process_time if device == "cpu" else time.perf_counter


def medians(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Returns the median of each value over rows of the same names."""
    return {name: median(row[name] for row in rows) for name in rows[0]}


def peak_mib() -> float:
    """Returns the peak memory of this process, MiB; ``ru_maxrss`` would include that of the process that forked it."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("this system does not report the peak memory of a process")


def device_name(device: str) -> str:
    """Returns the name of a GPU; empty for the CPU."""
    import warp as wp

    found = wp.get_device(device)
    return found.name if found.is_cuda else ""


@dataclass(frozen=True)
class TimedFrame:
    """Frame with its times, milliseconds."""

    frame: ls.Frame
    wall_ms: float
    stage_ms: dict[str, float]


class TimedRenderer:
    """Renders frames and times them, as a whole and stage by stage.

    A GPU runs asynchronously, and its stages are timed by waiting after each. A second renderer therefore does so, in
    frames of its own that are not timed as a whole.

    Args:
        config: Settings.
        device: As for ``ls.create_renderer``.
    """

    def __init__(self, config: ls.RenderConfig | None, device: str) -> None:
        self._config, self._device = config, device
        self._renderer = ls.create_renderer(config, device)
        self._profiled: ls.Renderer | None = None

    def render(self, scene: ls.Scene, camera: ls.Camera) -> TimedFrame:
        """Renders one frame with its colours on the host; on a GPU two."""
        begun = time.perf_counter()
        frame = self._renderer.render(scene, camera)
        assert frame.color.size
        wall_ms = 1e3 * (time.perf_counter() - begun)
        return TimedFrame(frame, wall_ms, stage_ms(frame) or self._stages(scene, camera))

    def _stages(self, scene: ls.Scene, camera: ls.Camera) -> dict[str, float]:
        """Returns the stage times of a frame that waits after each stage."""
        if self._profiled is None:
            self._profiled = ls.create_renderer(self._config, self._device, profile=True)
        return stage_ms(self._profiled.render(scene, camera))
