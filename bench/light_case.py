"""Times one lit preset in a process of its own: ``python -m bench.light_case NAME SCENE`` prints one JSON object.

SCENE is the file of `bench.light_presets.store_demo`. Frames of the preset and unlit raster frames take turns, so that
a machine that is busy for a while slows both.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from pathlib import Path

REPEATS = 15


def main(name: str, path: str) -> None:
    """Renders a first frame of both, then times ``REPEATS`` of each."""
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR
    import lumisplat as ls
    from bench.light_presets import BASE, LIGHT, camera, stored_demo
    from bench.presets import stage_ms

    demo, view = stored_demo(Path(path)), camera()
    preset = next(preset for preset in LIGHT if preset.name == name)
    turns = {part: (ls.create_renderer(part.config(), device="cpu"), part.scene(demo)) for part in (BASE, preset)}
    walls: dict = {part: [] for part in turns}
    stages = []
    for turn in range(REPEATS + 1):
        for part, (renderer, scene) in turns.items():
            begun = time.perf_counter()
            frame = renderer.render(scene, view)
            # The first ones upload, build trees and allocate.
            if turn > 0:
                walls[part].append(1e3 * (time.perf_counter() - begun))
                if part == preset:
                    stages.append(stage_ms(frame))
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
    main(*sys.argv[1:])
