"""What frames in real time cost beside paths that are as near to the truth.

``python -m bench.realtime_truth.equal_error`` prints, for a room with Gaussians and the demo scene, the PSNR of the
tone-mapped picture after so many frames and what a frame takes, then how many paths a pixel reach that PSNR, and how
many times longer these take than a frame of the running sequence, and than all of its frames from the first (bar: 20
times). Last the same beside one path a pixel that is denoised, the extra ``denoise`` (bar: 3 times): real time has the
number of frames that it takes to be as good.

Between and beyond the few numbers of paths that are compared, their squared error falls as one over their number. The
truth are other paths, whose noise is left out. Times are processor time of all threads, medians of frames of a running
sequence and of 4 paths a pixel, in turn. About 10 minutes, half of it for the truth; half a minute with ``--width 64
--samples 4 --frames 4 --only room``.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import lumisplat as ls
from bench.realtime_truth.frames import (
    Truth,
    add_quality,
    cpu_seconds,
    decibels,
    frames_of,
    head,
    options,
    paths,
    realtime,
    tell,
    truth_of,
)
from bench.realtime_truth.scenes import View, demo, rooms

SAMPLES = (1, 4, 16, 48)
WARM_FRAMES, TIMED = 4, 3
BARS = "20 times", "3 times"


@dataclass(frozen=True)
class Paths:
    """What paths of a view cost, and how good they are."""

    second: float
    """Of one path a pixel, processor time."""
    errors: tuple[float, ...]
    """Mean squared, of `SAMPLES`."""
    denoised: tuple[float, float] | None
    """Seconds and squared error of one path a pixel, denoised."""

    def samples(self, error: float) -> float:
        """Paths a pixel that reach an error."""
        logarithms = [math.log(count) for count in SAMPLES]
        losses = [math.log(value) for value in self.errors]
        if error <= self.errors[-1]:
            return SAMPLES[-1] * self.errors[-1] / error
        return math.exp(np.interp(-math.log(error), [-loss for loss in losses], logarithms))


def main() -> None:
    """Prints a table for each view."""
    asked = options("equal_error", __doc__, samples=64)
    asked.add_argument("--frames", type=int, default=64, help="of the sequence (default: 64)")
    add_quality(asked)
    asked.add_argument("--only", default="room,demo", help="some of room, demo")
    given = asked.parse_args()
    chosen = given.only.split(",")
    views = [*(rooms(given.width)[1:2] if "room" in chosen else ()), *([demo(given.width)] if "demo" in chosen else ())]
    for view in views:
        compared(view, given)


def compared(view: View, given: argparse.Namespace) -> None:
    """Prints the tables of a view."""
    truth = truth_of(view, given.samples, given.device, given.truths)
    errors = sequence(view, truth, given)
    frame, second = times(view, given)
    traced = traced_paths(view, truth, second, given.device)
    shown = ", ".join(f"{count}: {decibels(error):.1f}" for count, error in zip(SAMPLES, traced.errors, strict=True))
    print(f"{view.name}: {frame:.3f} s a frame, {traced.second:.3f} s a path a pixel; dB of paths a pixel: {shown}\n")
    head("frames", "PSNR, dB", "as good as paths", "times longer than a frame", "than all frames", "bar")
    for count in (n for n in (1, 2, 4, 8, 16, 32, 64, 128) if n <= given.frames):
        equal = traced.samples(errors[count - 1])
        longer = equal * traced.second / frame
        print(
            f"| {count} | {decibels(errors[count - 1]):.1f} | {equal:.1f} | {longer:.1f} | {longer / count:.1f} | "
            f"{BARS[0]} |"
        )
    if traced.denoised:
        beside_denoised(traced.denoised, errors, frame)
    print(flush=True)


def settings_of(given: argparse.Namespace) -> ls.RenderConfig:
    """Those of the sequence."""
    return realtime(aovs=(), realtime=ls.RealtimeConfig(quality=given.quality))


def sequence(view: View, truth: Truth, given: argparse.Namespace) -> list[float]:
    """Squared errors of the frames of a sequence."""
    tell(f"{given.frames} frames: {view.name}")
    frames = frames_of(ls.create_renderer(settings_of(given), given.device), view, given.frames)
    return [max(truth.squared_error(frame.pixels_srgb()), 1e-9) for frame in frames]


def times(view: View, given: argparse.Namespace) -> tuple[float, float]:
    """Seconds of a frame of a running sequence, and of one path a pixel, in turn."""
    renderers = [ls.create_renderer(config, given.device) for config in (settings_of(given), paths(4, seed=0))]
    taken: list[list[float]] = [[], []]
    for number in range(WARM_FRAMES + TIMED):
        for seconds, renderer in zip(taken, renderers, strict=True):
            is_timed = number >= WARM_FRAMES
            camera = view.camera if is_timed or renderer is renderers[0] else view.camera.scaled(16)
            found, _ = cpu_seconds(lambda renderer=renderer, camera=camera: shown(renderer.render(view.scene, camera)))
            if is_timed:
                seconds.append(found)
    frame, four_paths = (statistics.median(seconds) for seconds in taken)
    return frame, four_paths / 4


def shown(frame: ls.Frame) -> ls.Frame:
    """With its colours on the host."""
    assert frame.color.size
    return frame


def traced_paths(view: View, truth: Truth, second: float, device: str) -> Paths:
    """Few paths a pixel, the least of them denoised, too."""
    errors = list[float]()
    denoised = None
    for count in SAMPLES:
        tell(f"{count} paths a pixel: {view.name}")
        renderer = ls.create_renderer(paths(count, seed=0), device)
        frame = renderer.render(view.scene, view.camera)
        errors.append(truth.squared_error(frame.pixels_srgb()))
        if count == 1:
            denoised = denoised_once(frame, truth, second)
    return Paths(second, tuple(errors), denoised)


def denoised_once(frame: ls.Frame, truth: Truth, second: float) -> tuple[float, float] | None:
    """Seconds of a path a pixel and its denoising, and its squared error."""
    try:
        frame.denoised()  # the first one of a size makes the filter ready
    except ls.errors.MissingExtraError as error:
        tell(f"no denoised paths: {error}")
        return None
    more, clean = cpu_seconds(frame.denoised)
    return second + more, truth.squared_error(clean.pixels_srgb())


def beside_denoised(denoised: tuple[float, float], errors: Sequence[float], frame: float) -> None:
    """Prints the row of one path a pixel, denoised."""
    taken, error = denoised
    better = [number + 1 for number, ours in enumerate(errors) if ours <= error]
    print()
    head("1 path a pixel, denoised", "PSNR, dB", "frames that reach it", "longer than a frame", "than all", "bar")
    reached, than_all = (f"{better[0]}", f"{taken / better[0] / frame:.2f}") if better else ("none", "-")
    print(f"| {taken:.3f} s | {decibels(error):.1f} | {reached} | {taken / frame:.2f} | {than_all} | {BARS[1]} |")


if __name__ == "__main__":
    main()
