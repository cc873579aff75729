"""Which device benchmarks run on, and how long its frames and their stages take."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import lumisplat as ls
from bench.presets import stage_ms
from lumisplat.runtime.launcher import resolve_device


def parser(program: str, description: str | None) -> argparse.ArgumentParser:
    """A parser of the option that all benchmarks have."""
    given = argparse.ArgumentParser(
        prog=f"python -m bench.{program}", description=description, formatter_class=argparse.RawTextHelpFormatter
    )
    given.add_argument("--device", type=device_here, default="cpu", help="auto, cpu, cuda or cuda:N (default: cpu)")
    return given


def device_here(name: str) -> str:
    """The device that a name means on this machine."""
    try:
        return resolve_device(name)
    except ls.DeviceError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def quiet_warp() -> None:
    """Leaves standard output to the results."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR


def device_name(device: str) -> str:
    """What a GPU is called; empty for the CPU."""
    import warp as wp

    found = wp.get_device(device)
    return found.name if found.is_cuda else ""


@dataclass(frozen=True)
class TimedFrame:
    """A frame and what it took, milliseconds."""

    frame: ls.Frame
    wall_ms: float
    stage_ms: dict[str, float]


class TimedRenderer:
    """Renders frames and times them, each as a whole and stage by stage.

    A GPU runs ahead of the program, and its stages are timed by waiting after each: there, a second renderer does so,
    in frames of its own that are not timed as a whole.

    Args:
        config: Settings.
        device: As for ``ls.create_renderer``.
    """

    def __init__(self, config: ls.RenderConfig | None, device: str) -> None:
        self._config, self._device = config, device
        self._renderer = ls.create_renderer(config, device)
        self._profiled: ls.Renderer | None = None

    def render(self, scene: ls.Scene, camera: ls.Camera) -> TimedFrame:
        """One frame, its colours on the host; on a GPU two."""
        begun = time.perf_counter()
        frame = self._renderer.render(scene, camera)
        assert frame.color.size
        wall_ms = 1e3 * (time.perf_counter() - begun)
        return TimedFrame(frame, wall_ms, stage_ms(frame) or self._stages(scene, camera))

    def _stages(self, scene: ls.Scene, camera: ls.Camera) -> dict[str, float]:
        """What the stages of a frame take that waits after each."""
        if self._profiled is None:
            self._profiled = ls.create_renderer(self._config, self._device, profile=True)
        return stage_ms(self._profiled.render(scene, camera))
