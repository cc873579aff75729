"""Times one preset of `bench.run` in its own process, for separate memory and first-use figures (seconds).

``python -m bench.case NAME [DEMO] [--device cuda]`` prints one JSON object. DEMO is the file of
`bench.presets.store_demo`, for lit presets. Their frames alternate with unlit raster frames, so that other load on the
machine slows both.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

REPEATS, LIT_REPEATS = 20, 15


def main() -> None:
    """Prints one JSON object: milliseconds, counts and peak memory."""
    import lumisplat as ls
    from bench.presets import BIKER, LIGHT, PRESETS, synthetic
    from bench.timing import parser, quiet_warp

    given = parser("case", __doc__)
    given.add_argument("name")
    given.add_argument("demo", type=Path, nargs="?")
    options = given.parse_args()
    preset = next(preset for preset in [*PRESETS, *LIGHT] if preset.name == options.name)
    if preset in LIGHT:
        quiet_warp()
        print(json.dumps(lit_row(preset, options.demo, options.device)))
        return
    with tempfile.TemporaryDirectory() as folder:
        path = BIKER
        if preset.count:
            path = Path(folder) / "synthetic.ply"
            ls.save(path, synthetic(preset.count))
        # A new process, whose peak memory is that of loading and rendering alone.
        script = f"import bench.case as case; case.measure({preset.name!r}, {str(path)!r}, {options.device!r})"
        done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    print(done.stdout.splitlines()[-1])


def measure(name: str, path: str, device: str) -> None:
    """Loads, renders a first frame and ``REPEATS`` steady ones, and prints their times."""
    started = time.perf_counter()
    import lumisplat as ls

    capture = ls.load(path)
    assert isinstance(capture, ls.Gaussians)
    scene = ls.Scene(splats=[capture])
    loaded = time.perf_counter()
    from bench.presets import PRESETS
    from bench.timing import TimedRenderer, medians, peak_mib, quiet_warp

    quiet_warp()

    preset = next(preset for preset in PRESETS if preset.name == name)
    camera = preset.camera()
    renderer = TimedRenderer(preset.config(), device)
    ready = time.perf_counter()
    timed = renderer.render(scene, camera)
    first = time.perf_counter()
    build_ms, stats = timed.stage_ms.get("build", 0.0), timed.frame.stats
    assert stats is not None
    walls: list[float] = []
    stage_rows: list[dict[str, float]] = []
    for _ in range(REPEATS):
        timed = renderer.render(scene, camera)  # holding old frames would force new allocations
        walls.append(timed.wall_ms)
        stage_rows.append(timed.stage_ms)
    row = {
        "load_ms": 1e3 * (loaded - started),
        "start_ms": 1e3 * (ready - loaded),
        "first_ms": 1e3 * (first - ready),
        "frame_ms": median(walls),
        "frame_min_ms": min(walls),
        "frame_max_ms": max(walls),
        "build_ms": build_ms,
        "stage_ms": medians(stage_rows),
        "gaussians": stats.gaussian_count,
        "visible": stats.visible_count,
        "pairs": stats.pair_count,
        "peak_mib": peak_mib(),
    }
    print(json.dumps(row))


def lit_row(preset, path: Path, device: str) -> dict:
    """Times ``LIT_REPEATS`` frames of a lit preset and of unlit raster, alternating, after a first frame of each."""
    from bench.presets import BASE, lit_camera, stored_demo
    from bench.timing import TimedRenderer, medians

    demo, view = stored_demo(path), lit_camera()
    renderers = {part: (TimedRenderer(part.config(), device), part.scene(demo)) for part in (BASE, preset)}
    walls: dict = {part: [] for part in renderers}
    stages = []
    for repeat in range(LIT_REPEATS + 1):
        for part, (renderer, scene) in renderers.items():
            timed = renderer.render(scene, view)
            if repeat > 0:  # the first frames upload, build BVHs and allocate
                walls[part].append(timed.wall_ms)
                if part == preset:
                    stages.append(timed.stage_ms)
    middle = {part: median(times) for part, times in walls.items()}
    return {
        "frame_ms": middle[preset],
        "frame_min_ms": min(walls[preset]),
        "frame_max_ms": max(walls[preset]),
        "base_ms": middle[BASE],
        "ratio": middle[preset] / middle[BASE],
        "stage_ms": medians(stages),
    }


if __name__ == "__main__":
    main()
