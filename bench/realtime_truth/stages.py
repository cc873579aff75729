"""What each stage of frames in real time brings and costs: all settings that switch or scale one, each by itself.

``python -m bench.realtime_truth.stages [--view room|demo]`` prints, for each, the processor time of a frame and its
ratio to the default's, measured in turn; the signed bias of layers beside paths, in the mean of the last half of 64
frames; the PSNR of the tone-mapped picture after 8 and 64 frames; and that at equal time: after as many frames as take
what 16 take by default. ``acceptance 0.2`` are the scaled random numbers of Hu et al. 2025, section 3.3, for shadow
rays, to be compared with stochastic shadows: in the demo scene, for the Gaussians of the room let no light through.

About 15 minutes for the room, of rough metals with a ball and a wall of Gaussians; a minute with ``--width 64 --samples
4 --frames 4``.
"""

from __future__ import annotations

import argparse
import statistics
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import lumisplat as ls
from bench.realtime_truth.frames import (
    Doubles,
    Truth,
    bias,
    cpu_seconds,
    decibels,
    frames_of,
    head,
    layer_of,
    options,
    percent,
    realtime,
    tell,
    truth_of,
)
from bench.realtime_truth.scenes import View, demo, rooms

EQUAL_FRAMES = 16
"""Frames with the default settings whose time each has."""
TIMED = 5
"""Frames of each that are timed, in turn with the default's."""


@dataclass
class Sequence:
    """Frames of one setting."""

    name: str
    settings: dict[str, Any]
    errors: list[float] = field(default_factory=list)
    """Squared, of each frame."""
    milliseconds: float = 0.0
    ratio: float = 1.0
    """Of its time to the default's."""


def variants() -> dict[str, dict[str, Any]]:
    """Settings of a frame, by what they change."""
    real = ls.RealtimeConfig
    filters, probes, cache = ls.config.FilterConfig, ls.config.ProbeConfig, ls.config.RadianceCacheConfig
    of_realtime = {
        "default (balanced)": real(),
        "preview": real(quality=ls.config.RealtimeQuality.PREVIEW),
        "high": real(quality=ls.config.RealtimeQuality.HIGH),
        "no rays of highlights": real(highlight_rays=False),
        "light in every second frame": real(light_interval=2),
        "no filter over neighbours": real(filter=filters(passes=0)),
        "2 passes over neighbours": real(filter=filters(passes=2)),
        "no filter over frames": real(filter=filters(frames=1)),
        "8 frames": real(filter=filters(frames=8)),
        "128 frames and 32 of indirect light": real(filter=filters(frames=128, indirect_frames=32)),
        "probes every 16 pixels": real(probes=probes(tile=16)),
        "no antialiasing": real(antialiasing=False),
        "a tenth of the probes a frame": real(probes=probes(refreshed=0.1)),
        "all probes a frame": real(probes=probes(refreshed=1.0)),
        "no adaptive probes": real(probes=probes(adaptive=0.0)),
        "256 bounces in the cache a frame": real(cache=cache(bounces=256)),
        "32768 bounces in the cache a frame": real(cache=cache(bounces=32_768)),
        "cache without history": real(cache=cache(history=1, bounce_history=1)),
        "cells half as wide": real(cache=cache(cell_size=1.0 / 16.0)),
    }
    stochastic = ls.ShadowConfig(method=ls.config.ShadowMethod.STOCHASTIC)
    others: dict[str, dict[str, Any]] = {
        "direct light alone": {"max_bounces": 0},
        "stochastic shadows": {"shadow_rays": stochastic},
        "acceptance 0.2": {"shadow_rays": replace(stochastic, acceptance_scale=0.2)},
    }
    return {name: {"realtime": settings} for name, settings in of_realtime.items()} | others


def main() -> None:
    """Prints the table."""
    asked = options("stages", __doc__, samples=64)
    asked.add_argument("--frames", type=int, default=64, help="of each sequence (default: 64)")
    asked.add_argument("--view", choices=("room", "demo"), default="room")
    asked.add_argument("--only", help="some of the rows, by their names, with commas; the first one is the default's")
    given = asked.parse_args()
    chosen = variants() if given.only is None else {name: variants()[name] for name in given.only.split(",")}
    view = demo(given.width) if given.view == "demo" else rooms(given.width)[3]
    truth = truth_of(view, given.samples, given.device, given.truths)
    layers = ("diffuse", "glossy") if view.keeps_look else ("direct", "indirect", "glossy")
    said = [f"{layer}, bias" for layer in layers]
    last = f"PSNR after {min(8, given.frames)}"
    head(view.name, "CPU ms a frame", "times", *said, last, f"after {given.frames}", "at equal time")
    default = None
    for name, settings in chosen.items():
        tell(name)
        one = Sequence(name, settings)
        images = followed(one, layers, view, truth, given)
        timed(one, default or one, view, given.device)
        default = default or one
        off = [percent(bias(images[layer], truth.layer(layer), 1.0).mean) for layer in layers]
        equal = one.errors[min(max(round(EQUAL_FRAMES / one.ratio), 1), given.frames) - 1]
        levels = (one.errors[min(8, given.frames) - 1], one.errors[-1], equal)
        shown = " | ".join((*off, *(f"{decibels(error):.1f}" for error in levels)))
        print(f"| {name} | {one.milliseconds:,.0f} | {one.ratio:.2f} | {shown} |", flush=True)


def followed(
    one: Sequence, layers: tuple[str, ...], view: View, truth: Truth, given: argparse.Namespace
) -> dict[str, Doubles]:
    """Layers, the mean of the last half of its frames; notes the errors of all."""
    renderer = ls.create_renderer(realtime(**one.settings), given.device)
    late: list[ls.Frame] = []
    for number, frame in enumerate(frames_of(renderer, view, given.frames)):
        one.errors.append(truth.squared_error(frame.pixels_srgb()))
        late += [frame] if number >= given.frames // 2 else []
    return {layer: np.mean([layer_of(frame, layer) for frame in late], axis=0) for layer in layers}


def timed(one: Sequence, default: Sequence, view: View, device: str) -> None:
    """Times frames of it and of the default, in turn."""
    renderers = [ls.create_renderer(realtime(aovs=(), **each.settings), device) for each in (one, default)]
    taken: list[list[float]] = [[], []]
    for number in range(2 + TIMED):
        for times, renderer in zip(taken, renderers, strict=True):
            seconds, size = cpu_seconds(lambda renderer=renderer: renderer.render(view.scene, view.camera).color.size)
            assert size
            if number >= 2:
                times.append(seconds)
    ours, theirs = (statistics.median(times) for times in taken)
    one.milliseconds, one.ratio = 1e3 * ours, 1.0 if one is default else ours / theirs


if __name__ == "__main__":
    main()
