"""What a long walk holds: memory of the process and of the device, and tiles of the radiance cache.

``python -m bench.realtime_truth.walk`` renders 1,000 small frames of a room with Gaussians, in which the camera walks
to and fro, and prints what is held after some of them. After the first hundred it has to stay the same: the camera has
then been everywhere twice. About 3 minutes of processor time; ``--frames 40 --width 64`` takes seconds.
"""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter
from pathlib import Path

import numpy as np

import lumisplat as ls
from bench.realtime_truth.frames import head, options, realtime
from bench.realtime_truth.scenes import moved, rooms

WAY = 50
"""Frames to and fro."""
TILES = attrgetter("_integrators._realtime._indirect.cache.statistics")
"""What the cache of a renderer holds; no image tells it."""


def main() -> None:
    """Prints the table."""
    asked = options("walk", __doc__, width=96)
    asked.add_argument("--frames", type=int, default=1000, help="of the walk (default: 1000)")
    given = asked.parse_args()
    view = rooms(given.width)[3]
    renderer = ls.create_renderer(realtime(aovs=()), given.device)
    marks = {
        round(given.frames * share) for share in (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    }
    head("frame", "process, MiB", "device, MiB", "tiles of the cache", "cells", "evicted", "dropped")
    for number in range(1, given.frames + 1):
        turn = 2.0 * np.pi * number / WAY
        pose = moved(0.8 * np.sin(turn))
        pose[2, 3] = 0.5 - 0.5 * np.cos(turn)
        camera = replace(view.camera, camera_from_world=pose @ view.camera.camera_from_world)
        stats = renderer.render(view.scene, camera).stats
        if number in marks:
            assert stats is not None
            held = TILES(renderer)
            counts = " | ".join(f"{count:,}" for count in (held.tiles, held.cells, held.evicted, held.dropped))
            print(f"| {number:,} | {resident():.0f} | {stats.memory_bytes / 2**20:.1f} | {counts} |", flush=True)


def resident() -> float:
    """Memory of the process, MiB."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS:"))
    return int(line.split()[1]) / 1024.0


if __name__ == "__main__":
    main()
