"""Renders what `bench.pairs` asks for on stdin, answers with milliseconds; public names only: any revision can.

``python -m bench.pair_worker DEVICE`` is how it is started.
"""

from __future__ import annotations

import logging
import os
import sys
import time

import lumisplat as ls
from bench.light_presets import LIGHT, camera


def main() -> None:
    """A preset's name sets the scene and renders two frames; ``frame`` renders and times one."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # Warp prints to stdout
    logging.disable()
    demo, view, device = ls.demo_scene_lit(), camera(), sys.argv[1]
    renderer, scene = ls.create_renderer(device=device), demo
    for line in sys.stdin:
        if line.strip() != "frame":
            preset = next(preset for preset in LIGHT if preset.name == line.strip())
            renderer, scene = ls.create_renderer(preset.config(), device), preset.scene(demo)
            renderer.render(scene, view)
            renderer.render(scene, view)
        started = time.perf_counter()
        renderer.render(scene, view)
        print(1e3 * (time.perf_counter() - started), file=answers, flush=True)


if __name__ == "__main__":
    main()
