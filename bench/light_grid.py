"""What a frame in real time costs with many lamps: ``python -m bench.light_grid [--lamps 1 16 100 1000]``.

The lit demo scene at 320 x 240, with coloured lamps at random places in its room, as bright together whatever their
number. Seconds of processor time over all threads, the median of the frames after the first ones.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import replace
from typing import Any

import numpy as np

LAMPS = (1, 16, 100, 1000)
WARM_FRAMES, FRAMES = 3, 5
CANDELA = 12.0
"""Of all lamps together."""
LOW, HIGH = (-2.0, 0.3, -1.5), (2.0, 2.3, 2.0)
"""Corners of the box in which they hang; metres."""


def main() -> None:
    """Prints one JSON object with the seconds of a frame by the number of lamps."""
    from bench.timing import parser, quiet_warp

    options = parser("light_grid", __doc__)
    options.add_argument("--lamps", type=int, nargs="+", default=LAMPS)
    args = options.parse_args()
    quiet_warp()
    print(json.dumps({count: seconds(count, args.device) for count in args.lamps}))


def seconds(count: int, device: str) -> float:
    """Processor time of a frame."""
    import lumisplat as ls

    scene = replace(ls.demo_scene_lit(), lights=tuple(lamps(count)))
    view = ls.demo_cameras(320, 240)[0]
    renderer = ls.create_renderer(ls.RenderConfig(pipeline=ls.Pipeline.REALTIME), device)
    times: list[float] = []
    for _ in range(WARM_FRAMES + FRAMES):
        started = time.process_time()
        renderer.render(scene, view)
        times.append(time.process_time() - started)
    return round(statistics.median(times[WARM_FRAMES:]), 3)


def lamps(count: int) -> list[Any]:
    """Lamps of all colours, without range."""
    import lumisplat as ls

    rng = np.random.default_rng(0)
    places, colors = rng.uniform(LOW, HIGH, (count, 3)), rng.uniform(0.1, 1.0, (count, 3))
    return [
        ls.LightPoint(tuple(place), tuple(color), intensity=CANDELA / count)
        for place, color in zip(places.tolist(), colors.tolist(), strict=True)
    ]


if __name__ == "__main__":
    main()
