"""Measures the bias of real-time frames against path tracing in still scenes (10 minutes of CPU time).

``python -m bench.realtime_truth.bias`` prints, for rooms and the demo scene after 64 frames, the relative error of
16 x 16 pixel tiles in each layer. The targets on meshes are 3 % of direct, 5 % of indirect and 10 % of glossy light,
and twice that on Gaussians. Then the PSNR of tone-mapped frames (targets: 34 dB Cornell, 31 dB with Gaussians, 30 dB
demo scene), and white furnaces, which have to be 1 within 0.5 %. Where captures are unlit, direct and indirect diffuse
light are added, because the two pipelines assign captured radiance to different layers.

The error of a single frame is bias and noise. *32 frames* is the mean of the last half of the frames, whose error is
bias. The noise of the truth is removed from PSNR: the squared error is the product of the errors against two
independent halves of the truth. Its part of a tile's error is the last column. Most of the time is for the truth; a
quick run is ``--width 96 --samples 4 --frames 4 --only rooms``.
"""

from __future__ import annotations

import argparse

import numpy as np

import lumisplat as ls
from bench.realtime_truth.frames import (
    BARS,
    add_quality,
    bias,
    blocks,
    frames_of,
    layer_of,
    log,
    options,
    percent,
    realtime,
    truth_of,
)
from bench.realtime_truth.scenes import View, demo, furnaces, rooms
from bench.timing import print_head

FURNACE_BAR = 0.005


def main() -> None:
    """Prints the tables."""
    asked = options("bias", __doc__, samples=64)
    asked.add_argument("--frames", type=int, default=64, help="frames of each sequence (default: 64)")
    asked.add_argument("--only", default="rooms,demo,furnaces", help="some of rooms, demo, furnaces")
    add_quality(asked)
    given = asked.parse_args()
    chosen = given.only.split(",")
    views = [*(rooms(given.width) if "rooms" in chosen else ()), *([demo(given.width)] if "demo" in chosen else ())]
    pictures = list[str]()
    if views:
        of = "mean", "rms of tiles", "largest", "above target"
        print_head("view", "layer", "target", *of, *(f"32 frames: {name}" for name in of), "truth's noise")
        for view in views:
            pictures.append(compared(view, given))
        print()
        print_head("view", "PSNR, dB", "with the truth's noise", "target")
        print("\n".join(pictures), flush=True)
    if "furnaces" in chosen:
        print()
        print_head("furnace, farthest of three views", "mean", "worst tile of 32 frames", "worst tile of one", "target")
        print("\n".join(heated(given)))


def compared(view: View, given: argparse.Namespace) -> str:
    """Prints the rows of a view's layers, and returns that of its tone-mapped frame."""
    truth = truth_of(view, given.samples, given.device, given.truths)
    log(f"{given.frames} frames: {view.name}")
    *_, frame = frames = list(
        frames_of(
            ls.create_renderer(realtime(realtime=ls.RealtimeConfig(quality=given.quality)), given.device),
            view,
            given.frames,
        )
    )
    for name in ("diffuse", "glossy", "color") if view.is_unlit else ("direct", "indirect", "glossy", "color"):
        if not truth.layer(name).any():
            continue
        bar = view.slack * BARS[name] if name in BARS else np.inf
        found = bias(layer_of(frame, name), truth.layer(name), bar)
        late = np.mean([layer_of(one, name) for one in frames[given.frames // 2 :]], axis=0)
        steady = bias(late, truth.layer(name), bar)
        beyond = [percent(one.beyond) if name in BARS else "-" for one in (found, steady)]
        shown = [view.name, name, percent(bar, 0) if name in BARS else "-"]
        shown += [percent(value) for value in (found.mean, found.rms, found.largest)] + beyond[:1]
        shown += [percent(value) for value in (steady.mean, steady.rms, steady.largest)] + beyond[1:]
        print(f"| {' | '.join(shown)} | {percent(found.noise)} |", flush=True)
    picture = frame.pixels_srgb()
    plain = ls.metrics.psnr(picture, truth.whole.astype(np.float32))
    return f"| {view.name} | {truth.psnr(picture):.1f} | {plain:.1f} | {view.psnr_min or '-'} |"


def heated(given: argparse.Namespace) -> list[str]:
    """Returns the rows of the furnaces: mean of the last half of the frames, and the worst tiles."""
    found: dict[str, list[tuple[float, float, float]]] = {}
    for view in furnaces(given.width // 2):
        log(f"{given.frames} frames: furnace, {view.name}")
        frames = list(frames_of(ls.create_renderer(realtime(aovs=()), given.device), view, given.frames))
        late = np.mean(np.stack([frame.color - 1.0 for frame in frames[given.frames // 2 :]]), axis=0)
        steady, last = (float(max(blocks(image).flat, key=abs)) for image in (late, frames[-1].color - 1.0))
        found.setdefault(view.name, []).append((float(late.mean()), steady, last))
    return [
        f"| {name} | {' | '.join(percent(max(views, key=abs), 2) for views in zip(*values, strict=True))} "
        f"| {percent(FURNACE_BAR)} |"
        for name, values in found.items()
    ]


if __name__ == "__main__":
    main()
