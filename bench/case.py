"""Times one preset in a process of its own, so that memory and first use are the preset's.

``python -m bench.case NAME [--device cuda]`` prints one JSON object.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from pathlib import Path

REPEATS = 20


def main() -> None:
    """Prints one JSON object: milliseconds, counts and peak memory."""
    import lumisplat as ls
    from bench.presets import BIKER, PRESETS, synthetic
    from bench.timing import parser

    given = parser("case", __doc__)
    given.add_argument("name")
    options = given.parse_args()
    preset = next(preset for preset in PRESETS if preset.name == options.name)
    with tempfile.TemporaryDirectory() as folder:
        path = BIKER
        if preset.count:
            path = Path(folder) / "synthetic.ply"
            ls.save(path, synthetic(preset.count))
        print(json.dumps(timed(path, preset, options.device)))


def timed(path: Path, preset, device: str) -> dict:
    """Loads in a process whose peak memory is then that of loading and rendering alone."""
    import subprocess

    script = f"import bench.case as case; case.measure({preset.name!r}, {str(path)!r}, {device!r})"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def measure(name: str, path: str, device: str) -> None:
    """Loads, renders a first frame and ``REPEATS`` steady ones, and prints what they took."""
    started = time.perf_counter()
    import lumisplat as ls

    capture = ls.load(path)
    assert isinstance(capture, ls.Gaussians)
    scene = ls.Scene(splats=[capture])
    loaded = time.perf_counter()
    from bench.presets import PRESETS
    from bench.timing import TimedRenderer, quiet_warp

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
        timed = renderer.render(scene, camera)  # frames that are kept would make each new one take memory anew
        walls.append(timed.wall_ms)
        stage_rows.append(timed.stage_ms)
    stages = {name: statistics.median(row[name] for row in stage_rows) for name in stage_rows[0]}
    row = {
        "load_ms": 1e3 * (loaded - started),
        "start_ms": 1e3 * (ready - loaded),
        "first_ms": 1e3 * (first - ready),
        "frame_ms": statistics.median(walls),
        "frame_min_ms": min(walls),
        "frame_max_ms": max(walls),
        "build_ms": build_ms,
        "stage_ms": stages,
        "gaussians": stats.gaussian_count,
        "visible": stats.visible_count,
        "pairs": stats.pair_count,
        "peak_mib": peak_mib(),
    }
    print(json.dumps(row))


def peak_mib() -> float:
    """Largest resident memory of this process; ``ru_maxrss`` would include what its parent had when it was forked."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("this system does not report the peak memory of a process")


if __name__ == "__main__":
    main()
