"""What frames of rays and their derivatives cost.

``python -m bench.ray_gradients CAPTURE`` prints milliseconds of a frame of 256 x 256 pixels, one ray each, and of the
way back from it, of a decimated capture and of the capture itself, with kernels of degrees 2 and 4: processor time on a
CPU, wall time on a GPU.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.timing import parser, quiet_warp

SIZE = 256
COUNT = 10_000
REPEATS = 7
STAGES = ("backward: hits", "backward: rays", "backward: sort", "backward: Gaussians")


def main() -> None:
    """Prints a table."""
    arguments = parser("ray_gradients", __doc__)
    arguments.add_argument("path", type=Path, help="a capture")
    options = arguments.parse_args()
    quiet_warp()
    capture = ls.load(options.path)
    assert isinstance(capture, ls.Gaussians)
    camera = ls.frame_camera(ls.Scene([capture]), width=SIZE, height=SIZE)
    print(f"load of the machine before: {os.getloadavg()[0]:.1f}\n")
    print("| Gaussians | degree | hits | forward | backward |", " | ".join(STAGES), "| backward / forward |")
    print("| ---: |" + " ---: |" * (len(STAGES) + 5))
    for gaussians in (ls.editing.decimate(capture, COUNT), capture):
        for degree in (2, 4):
            print(row(replace(gaussians, kernel_degree=degree), camera, options.device), flush=True)
    print(f"\nload of the machine after: {os.getloadavg()[0]:.1f}")


def row(gaussians: ls.Gaussians, camera: ls.Camera, device: str) -> str:
    """Medians of a capture."""
    scene, clock = ls.Scene([gaussians]), time.process_time if device == "cpu" else time.perf_counter
    renderer = ls.DifferentiableRenderer(ls.RenderConfig(pipeline=ls.Pipeline.TRACE), device)
    renderer._launcher.clock = clock
    by_color = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)

    def forward() -> float:
        return float(renderer.render(scene, camera).color[0, 0, 0])

    times, stages = np.zeros((REPEATS, 2)), np.zeros((REPEATS, len(STAGES)))
    for repeat in range(-2, REPEATS):
        forward_s = timed(forward, clock)
        renderer._launcher.stage_ms = {}
        times[repeat] = forward_s, timed(lambda: renderer.gradients(by_color), clock)
        stages[repeat] = [renderer._launcher.stage_ms.get(name, np.nan) for name in STAGES]
    assert renderer._traced is not None
    hits = int(renderer._traced.hits.gaussians.hits.numpy().sum())
    there, back = 1e3 * np.median(times, axis=0)
    parts = " | ".join(f"{value:.1f}" for value in np.median(stages, axis=0))
    of = f"| {gaussians.count:,} | {gaussians.kernel_degree} | {hits:,}"
    return f"{of} | {there:.0f} | {back:.0f} | {parts} | {back / there:.2f} |"


def timed(work: Callable[[], object], clock: Callable[[], float]) -> float:
    """Seconds."""
    begun = clock()
    work()
    return clock() - begun


if __name__ == "__main__":
    main()
