"""Measures how soon real-time frames follow changes, and how stable they are otherwise (10 minutes).

``python -m bench.realtime_truth.lag`` prints

* the fraction of light that is gone some frames after a light was switched off, in a closed room, with and without
  another light (targets: 90 % after 8 frames direct, after 24 indirect); *slowest* is the value that 95 % of the
  16 x 16 pixel tiles reach;
* the fraction of the old shadow of a ball that remains after it has jumped aside, and of the light at its new shadow;
  then the relative difference of the light there, including indirect light, from its final value (targets: 5 % after
  24 frames);
* the error of disoccluded pixels after the jump and after a step of the camera, over that of the same pixels after 64
  still frames (target: 2 after 8 frames), and how many of them are black;
* the difference of a sequence whose camera was away for 16 frames from a still one, over the difference of two still
  ones with other random numbers (1: within the noise);
* the fraction of pixels of a still scene that flicker by less than 1 %, as standard deviation over mean of 32 frames
  (target: 95 %).

Errors are root mean squares of tone-mapped frames; those of disoccluded pixels are against paths, without their noise.
A quick run is ``--width 64 --samples 4 --only lamps,shadow,seen,trip``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from bench.realtime_truth.frames import (
    FAINT,
    Doubles,
    Truth,
    blocks,
    frames_of,
    last_of,
    layer_of,
    log,
    options,
    percent,
    realtime,
    rms,
    truth_of,
)
from bench.realtime_truth.scenes import View, aside, dark_room, demo, rooms, with_ball_at
from bench.timing import print_head
from support.scenes.path_rooms import room_camera

Mask = npt.NDArray[np.bool_]

AFTER = (1, 2, 4, 8, 16, 24)
"""Frames after a change, counting the first that shows it."""
STEADY = 64
JUMP, STEP = 1.5, 0.4
"""Distances of the jump of the ball and of the step of the camera, scene units."""
SHADED = 0.5
"""Fraction of the direct light below which a pixel counts as inside a shadow."""
FLICKER = 0.01
PARTS = ("lamps", "shadow", "seen", "trip", "flicker")


def main() -> None:
    """Prints the tables."""
    asked = options("lag", __doc__, samples=64)
    asked.add_argument("--only", default=",".join(PARTS), help="some of " + ", ".join(PARTS))
    given = asked.parse_args()
    tables = {"lamps": lamps, "shadow": shadow, "seen": newly_seen, "trip": trip, "flicker": flicker}
    for name in given.only.split(","):
        log(name)
        tables[name](given)
        print(flush=True)


def camera_of(given: argparse.Namespace) -> ls.Camera:
    """Returns the camera of the closed room."""
    return room_camera(given.width, 3 * given.width // 4)


def row(name: str, values: Sequence[float], bar: str) -> None:
    """Prints a line of fractions by number of frames."""
    print(f"| {name} | {' | '.join(percent(value) for value in values)} | {bar} |", flush=True)


def lamps(given: argparse.Namespace) -> None:
    """Measures a light that is switched off."""
    print_head("gone after frames", *(str(count) for count in AFTER), "bar")
    light = ls.LightPoint((2.0, 2.5, 2.5), intensity=10.0)
    other = ls.LightPoint((0.8, 1.0, 4.2), intensity=3.0)
    for name, rest in {"alone": (), "beside another lamp": (other,)}.items():
        lit = View(name, ls.Scene((), dark_room(), [light, *rest]), camera_of(given))
        out = replace(lit, scene=replace(lit.scene, lights=(replace(light, intensity=0.0), *rest)))
        renderer = ls.create_renderer(realtime(), given.device)
        before = [last_of(renderer, lit, STEADY)]
        frames = list(frames_of(renderer, out, AFTER[-1]))
        after = list(frames_of(ls.create_renderer(realtime(), given.device), out, STEADY))[-16:]
        for layer, frame in (("direct", 8), ("indirect", 24)):
            start, end = (np.mean([blocks(layer_of(one, layer)) for one in few], axis=0) for few in (before, after))
            lost = start - end
            much = lost > FAINT * lost.mean()
            shares = [1.0 - (blocks(layer_of(frames[count - 1], layer)) - end)[much] / lost[much] for count in AFTER]
            means = [float(np.sum(share * lost[much]) / lost[much].sum()) for share in shares]
            row(f"{layer}, {name}", means, f"90 % after {frame}")
            row(f"{layer}, {name}, slowest", [float(np.percentile(share, 5)) for share in shares], "")


def shadow(given: argparse.Namespace) -> None:
    """Measures the shadow of a ball that jumps aside."""
    print_head("left after frames", *(str(count) for count in AFTER), "bar")
    here, there = (View("ball", with_ball_at(x), camera_of(given)) for x in (0.0, JUMP))
    renderer = ls.create_renderer(realtime(), given.device)
    before = last_of(renderer, here, STEADY)
    frames = list(frames_of(renderer, there, AFTER[-1]))
    after = list(frames_of(ls.create_renderer(realtime(), given.device), there, STEADY))[-16:]
    still = before.instance_index == after[0].instance_index
    start, end = layer_of(before, "direct"), np.mean([layer_of(frame, "direct") for frame in after], axis=0)
    masks = {
        "old shadow": still & (start.mean(axis=2) < SHADED * end.mean(axis=2)),
        "light where the new shadow is": still & (end.mean(axis=2) < SHADED * start.mean(axis=2)),
    }
    steady = np.mean([frame.color for frame in after], axis=0)
    for name, mask in masks.items():
        whole = float((start - end)[mask].mean())
        left = [float((layer_of(frames[count - 1], "direct") - end)[mask].mean()) / whole for count in AFTER]
        row(f"{name}, {int(mask.sum()):,} pixels: direct light", left, "5 % after 24")
        off = [float(frames[count - 1].color[mask].mean() / steady[mask].mean()) - 1.0 for count in AFTER]
        row("all light there, too much", off, "5 % after 24")


def newly_seen(given: argparse.Namespace) -> None:
    """Measures disoccluded pixels, which have no history."""
    counts = [count for count in AFTER if count <= 8]
    print_head("error over the steady one after frames", *(str(count) for count in counts), "steady", "black", "bar")
    here = View("ball", with_ball_at(0.0), camera_of(given))
    changes = {
        "the ball jumps": replace(here, name="ball aside", scene=with_ball_at(JUMP)),
        "the camera steps": replace(here, name="camera aside", camera=aside(here.camera, STEP)),
    }
    for name, there in changes.items():
        truth = truth_of(there, given.samples, given.device, given.truths)
        renderer = ls.create_renderer(realtime(aovs="history"), given.device)
        last_of(renderer, here, STEADY)
        frames = list(frames_of(renderer, there, counts[-1]))
        history = frames[0].history
        assert history is not None
        is_new = (history < 1.5) & (truth.pictures.max(axis=(0, 3)) > 0.02)
        steady = last_of(ls.create_renderer(realtime(), given.device), there, STEADY)
        expected = error_at(is_new, steady, truth)
        errors = [error_at(is_new, frames[count - 1], truth) / expected for count in counts]
        black = max(int((frame.color.max(axis=2)[is_new] <= 0.0).sum()) for frame in frames)
        shown = " | ".join(f"{error:.2f}" for error in errors)
        print(f"| {name}, {int(is_new.sum()):,} pixels | {shown} | {expected:.4f} | {black} | 2 after 8 |", flush=True)


def error_at(mask: Mask, frame: ls.Frame, truth: Truth) -> float:
    """Returns the root mean square error of a tone-mapped frame, without the truth's noise."""
    first, second = (frame.pixels_srgb()[mask] - half[mask] for half in truth.pictures)
    return float(np.sqrt(max(np.mean(first * second), 1e-8)))


def trip(given: argparse.Namespace) -> None:
    """Measures a camera that goes away and comes back."""
    print_head("difference over noise after frames", *(str(count) for count in AFTER), "bar")
    here = View("ball", with_ball_at(0.0), camera_of(given))
    path = np.sin(np.linspace(0.0, np.pi, 17))[1:-1]
    renderer = ls.create_renderer(realtime(), given.device)
    last_of(renderer, here, STEADY)
    for share in path:
        renderer.render(here.scene, aside(here.camera, 2.0 * STEP * float(share)))
    back = list(frames_of(renderer, here, AFTER[-1]))
    first, second = (
        list(frames_of(ls.create_renderer(realtime(seed=seed), given.device), here, STEADY + len(path) + AFTER[-1]))
        for seed in (1, 2)
    )
    ratios: list[float] = []
    for count in AFTER:
        one, two, three = (frames[count - 1 - AFTER[-1]].pixels_srgb() for frames in (back, first, second))
        ratios.append(rms(np.subtract(one, two, dtype=np.float64)) / rms(np.subtract(two, three, dtype=np.float64)))
    shown = " | ".join(f"{ratio:.2f}" for ratio in ratios)
    print(f"| {2.0 * STEP:g} to the right and back | {shown} | 1 |", flush=True)


def flicker(given: argparse.Namespace) -> None:
    """Measures flicker while nothing moves."""
    print_head("flicker", "pixels below 1 %", "of blocks", "median", "95th percentile", "bar")
    for view in (*rooms(given.width), demo(given.width)):
        log(view.name)
        renderer = ls.create_renderer(realtime(), given.device)
        last_of(renderer, view, STEADY)
        light = np.stack([frame.color for frame in frames_of(renderer, view, 32)]).astype(np.float64)
        of_pixels, of_blocks = deviation(light.mean(axis=3)), deviation(np.stack([blocks(one) for one in light]))
        middle, high = np.percentile(of_pixels, (50, 95))
        print(
            f"| {view.name} | {percent(float(np.mean(of_pixels < FLICKER)))} | "
            f"{percent(float(np.mean(of_blocks < FLICKER)))} | {percent(middle, 2)} | {percent(high, 2)} | 95 % |",
            flush=True,
        )


def deviation(values: Doubles) -> Doubles:
    """Returns standard deviation over mean along the first axis; faint pixels are divided by the frame's mean."""
    mean = values.mean(axis=0)
    return values.std(axis=0) / np.maximum(mean, FAINT**2 * mean.mean())


if __name__ == "__main__":
    main()
