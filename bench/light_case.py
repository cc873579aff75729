"""Times one lit preset in a process of its own: ``python -m bench.light_case NAME SCENE [--device cuda]``.

SCENE is the file of `bench.light_presets.store_demo`. Frames of the preset and unlit raster frames take turns, so that
a machine that is busy for a while slows both.
"""

from __future__ import annotations

import json
import statistics
from pathlib import Path

REPEATS = 15


def main() -> None:
    """Renders a first frame of both, times ``REPEATS`` of each, and prints one JSON object."""
    from bench.light_presets import BASE, LIGHT, camera, stored_demo
    from bench.timing import TimedRenderer, parser, quiet_warp

    given = parser("light_case", __doc__)
    given.add_argument("name")
    given.add_argument("scene", type=Path)
    options = given.parse_args()
    quiet_warp()
    demo, view = stored_demo(options.scene), camera()
    preset = next(preset for preset in LIGHT if preset.name == options.name)
    turns = {part: (TimedRenderer(part.config(), options.device), part.scene(demo)) for part in (BASE, preset)}
    walls: dict = {part: [] for part in turns}
    stages = []
    for turn in range(REPEATS + 1):
        for part, (renderer, scene) in turns.items():
            timed = renderer.render(scene, view)
            # The first ones upload, build trees and allocate.
            if turn > 0:
                walls[part].append(timed.wall_ms)
                if part == preset:
                    stages.append(timed.stage_ms)
    middle = {part: statistics.median(times) for part, times in walls.items()}
    row = {
        "frame_ms": middle[preset],
        "frame_min_ms": min(walls[preset]),
        "frame_max_ms": max(walls[preset]),
        "base_ms": middle[BASE],
        "ratio": middle[preset] / middle[BASE],
        "stage_ms": {stage: statistics.median(times[stage] for times in stages) for stage in stages[0]},
    }
    print(json.dumps(row))


if __name__ == "__main__":
    main()
