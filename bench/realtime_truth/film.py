"""Renders a film of a moving scene in real time, with denoised paths beside every 12th frame (25 minutes of CPU time).

``python -m bench.realtime_truth.film OUT`` renders 96 frames of the moving demo room, or of ``--scene playbot``: 12
stand still, in 48 everything moves, and in the others the light settles. The camera moves aside and back. OUT receives
``film.webp``, the frames, the paths (those there already are kept), and pictures of frame, paths and four times their
difference side by side.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

import lumisplat as ls
from bench.realtime_truth.frames import add_quality, decibels, log, options, paths
from bench.realtime_truth.motion import FPS, Moving, moving_room, playbot
from bench.realtime_truth.playbot import missing

FRAMES = 96
STILL = 12
EVERY = 12
WARM_UP = 32
"""Number of frames rendered before the first one of the film."""

ASIDE = 0.4
"""How far the camera moves aside, scene units."""


def view_at(moving: Moving, number: int) -> tuple[ls.Scene, ls.Camera]:
    """Returns scene and camera of frame ``number`` of the film, negative before its first."""
    aside = np.eye(4)
    aside[0, 3] = -ASIDE * math.sin(math.pi * max(number, 0) / FRAMES) ** 2
    camera = replace(moving.camera, camera_from_world=aside @ moving.camera.camera_from_world)
    return moving.scene((number - STILL) / FPS), camera


def write(path: Path, pixels: npt.NDArray[np.floating]) -> None:
    """Writes sRGB pixels, 0..1, as an image."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(pixels, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)).save(path)


def main() -> None:
    """Renders the film and the paths."""
    asked = options("film", __doc__, width=960)
    asked.add_argument("out", type=Path, metavar="OUT")
    asked.add_argument("--scene", choices=("room", "playbot"), default="room", help="(default: room)")
    asked.add_argument("--samples", type=int, default=16, help="samples per pixel of the paths (default: 16)")
    add_quality(asked)
    given = asked.parse_args()
    if given.scene == "playbot" and missing():
        print(f"playbot: skipped, without {', '.join(missing())} (set LUMISPLAT_DATA)")
        return
    moving = playbot(given.width) if given.scene == "playbot" else moving_room(given.width)
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.REALTIME,
        realtime=ls.RealtimeConfig(quality=given.quality),
        tone_map=ls.ToneMap.NEUTRAL,
    )
    renderer = ls.create_renderer(config, given.device)
    pictures: list[npt.NDArray[np.floating]] = []
    for number in range(-WARM_UP, FRAMES):
        picture = renderer.render(*view_at(moving, number)).pixels_srgb()
        if number >= 0:
            pictures.append(picture)
            write(given.out / "frames" / f"{number:04d}.png", picture)
    ls.save_animation(given.out / "film.webp", pictures, fps=FPS)
    for number in range(0, FRAMES, EVERY):
        stored = given.out / "paths" / f"{number:04d}.png"
        if not stored.is_file():
            frame = ls.create_renderer(paths(given.samples, 1), given.device).render(*view_at(moving, number))
            write(stored, frame.denoised().pixels_srgb())
        truth = np.asarray(Image.open(stored), np.float32) / 255.0
        off = pictures[number] - truth
        beside = np.concatenate([pictures[number], truth, 4.0 * np.abs(off)], axis=1)
        write(given.out / "beside" / f"{number:04d}.png", beside)
        log(f"frame {number}: {decibels(float(np.mean(off * off))):.1f} dB from denoised paths")


if __name__ == "__main__":
    main()
