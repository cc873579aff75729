"""Measures real-time frames against path tracing while lamps and a figure move, and after they stop (10 minutes).

``python -m bench.realtime_truth.motion`` renders the moving demo room, or with ``--scene playbot`` a room with a
captured robot, 24 frames a second: 48 still frames, 48 frames of motion, and 24 frames after its end. The table shows,
at rest, in the middle and at the end of the motion and some frames after it, the PSNR of the tone-mapped frame without
the truth's noise, and the errors of each layer: signed mean, and root mean square and largest of 16 x 16 pixel blocks.
Targets: 33 dB at rest, 30 dB in motion; mean errors of 2 % direct, 4 % indirect and 8 % glossy.

``--save`` writes the frames beside their truths. ``--truths`` keeps the path-traced frames.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.realtime_truth.frames import Truth, add_quality, bias, layer_of, log, options, percent, realtime, truth_of
from bench.realtime_truth.playbot import missing, playbot_camera, playbot_scene
from bench.realtime_truth.scenes import View
from bench.timing import print_head
from lumisplat.demo.moving import COUNT, DURATION, moving_camera, moving_scene

FPS = 24.0
STILL_FRAMES = 48
END = round(FPS * DURATION)
"""Number of the first frame in which everything stands still again."""
MIDDLE = END // 2
AFTER = (1, 2, 4, 8, 16, 24)
"""Frames after the last one of the motion."""
LAYERS = ("direct", "indirect", "glossy", "color")
WIDTH = 320


@dataclass(frozen=True)
class Moving:
    """Scene by time, with a camera."""

    name: str
    scene: Callable[[float], ls.Scene]
    camera: ls.Camera

    def view(self, number: int) -> View:
        """Returns the scene of frame ``number``, negative before the motion."""
        return View(self.name, self.scene(number / FPS), self.camera)


def moving_room(width: int, count: int = COUNT) -> Moving:
    """Returns the moving demo room."""
    camera = moving_camera(width, 9 * width // 16)
    return Moving(f"moving room {count}", lambda time: moving_scene(time, count), camera)


def playbot(width: int) -> Moving:
    """Returns the room with the captured robot."""
    return Moving("playbot", playbot_scene, playbot_camera(width))


def main() -> None:
    """Prints the table."""
    asked = options("motion", __doc__, samples=96, width=WIDTH)
    asked.add_argument("--scene", choices=("room", "playbot"), default="room", help="(default: room)")
    asked.add_argument("--count", type=int, default=COUNT, help=f"Gaussians of the room (default: {COUNT:,})")
    asked.add_argument("--save", type=Path, metavar="FOLDER", help="writes frames and truths there")
    add_quality(asked)
    given = asked.parse_args()
    if given.scene == "playbot" and missing():
        print(f"playbot: skipped, without {', '.join(missing())} (set LUMISPLAT_DATA)")
        return
    moving = playbot(given.width) if given.scene == "playbot" else moving_room(given.width, given.count)
    moments = {0: "at rest", MIDDLE: "in motion", END - 1: "last of the motion"}
    moments |= {END - 1 + count: f"{count} after" for count in AFTER}
    config = realtime(realtime=ls.RealtimeConfig(quality=given.quality))
    renderer = ls.create_renderer(config, given.device)
    names = [f"{name}: {of}" for name in LAYERS for of in ("mean", "rms", "worst block")]
    print_head(moving.name, "PSNR, dB", *names)
    for number in range(1 - STILL_FRAMES, END + AFTER[-1]):
        view = moving.view(number)
        frame = renderer.render(view.scene, view.camera)
        if number in moments:
            print(row(moments[number], frame, truth_at(moving, number, given), given), flush=True)


def truth_at(moving: Moving, number: int, given: argparse.Namespace) -> Truth:
    """Returns the path-traced truth of a frame."""
    at = min(max(number, 0), END)
    view = replace(moving.view(at), name=f"{moving.name} {at}")
    return truth_of(view, given.samples, given.device, given.truths)


def row(name: str, frame: ls.Frame, truth: Truth, given: argparse.Namespace) -> str:
    """Returns a line of the table."""
    values: list[str] = []
    for layer in LAYERS:
        found = bias(layer_of(frame, layer), truth.layer(layer), np.inf)
        values += [percent(found.mean), percent(found.rms), percent(found.largest, 0)]
    if given.save:
        log(f"saving {name}")
        given.save.mkdir(parents=True, exist_ok=True)
        np.savez(
            given.save / f"{name.replace(' ', '_')}.npz",
            picture=frame.pixels_srgb(),
            truth=truth.whole,
            **{layer: layer_of(frame, layer) for layer in LAYERS},
            **{f"truth_{layer}": truth.layer(layer).mean(axis=0) for layer in LAYERS},
        )
    return f"| {name} | {truth.psnr(frame.pixels_srgb()):.1f} | {' | '.join(values)} |"


if __name__ == "__main__":
    main()
