"""``lumisplat bench``: how fast a scene renders on this machine."""

from __future__ import annotations

import re
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.console import byte_size, print_table, progress_bars
from lumisplat.cli.options import DeviceCommand, load_scene
from lumisplat.cli.stats import count_rows, stage_rows, stage_times
from lumisplat.cli.tracing import PipelineName, StrategyName, warn_unused


@dataclass(frozen=True, kw_only=True)
class Bench(DeviceCommand):
    """Time loading, the first frame and steady frames of your scene, or of the demo.

    Every frame is of the same camera: the first of the file, or the one that render takes when it is given none. Times
    are medians. The benchmarks against other renderers are `make bench` in the repository.
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Files as for render; none: the demo scene."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """transforms.json (nerfstudio) or cameras.json (INRIA)."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; the aspect ratio is kept."""
    pipeline: PipelineName = "raster"
    """As for render."""
    strategy: StrategyName = "sorted"
    """As for render, with --pipeline trace."""
    repeats: Annotated[int, arg(metavar="N")] = 20
    """Steady frames to time."""

    def run(self) -> None:
        """Measures and prints a table."""
        if self.repeats < 1:
            raise ls.ConfigError(f"--repeats is {self.repeats}, expected at least 1")
        config = ls.RenderConfig(
            pipeline=ls.Pipeline(self.pipeline), trace=ls.TraceConfig(strategy=ls.TraceStrategy(self.strategy))
        )
        warn_unused(["--strategy"] if self.pipeline == "raster" and self.strategy != "sorted" else [], self.pipeline)
        cameras = None if self.cameras is None else ls.load_cameras(self.cameras)
        with progress_bars() as report:
            started = time.perf_counter()
            renderer = self.start_renderer(report, config)
            ready = time.perf_counter()
            scene = load_scene(self.scene, drop_invalid=False, report=report) if self.scene else ls.demo_scene(report)
            loaded = time.perf_counter()
            camera = self._camera(cameras, scene)
            frame = renderer.render(scene, camera)
            first_ms = 1e3 * (time.perf_counter() - loaded)
            frame_ms, stages = [], []
            for done in range(self.repeats):
                report("timing", done / self.repeats)
                begun = time.perf_counter()
                frame = renderer.render(scene, camera)
                frame_ms.append(1e3 * (time.perf_counter() - begun))
                stages.append(stage_times(frame))
        medians = {name: statistics.median(row[name] for row in stages) for name in stages[0]}
        rows = [
            ("start, kernels", f"{1e3 * (ready - started):8.1f} ms"),
            ("load" if self.scene else "build demo", f"{1e3 * (loaded - ready):8.1f} ms"),
            ("first frame", f"{first_ms:8.1f} ms"),
            (f"frame, median of {self.repeats}", f"{statistics.median(frame_ms):8.1f} ms"),
            *stage_rows(medians),
            *count_rows(frame, self.pipeline),
        ]
        peak = _peak_bytes()
        if peak is not None:
            rows.append(("peak of the process", byte_size(peak)))
        print_table(f"{renderer.device}, {camera.width} x {camera.height}", rows)

    def _camera(self, cameras: list[ls.Camera] | None, scene: ls.Scene) -> ls.Camera:
        from lumisplat.cli.framing import framing_camera

        if cameras is None:
            cameras = [framing_camera(scene)] if self.scene else ls.demo_cameras()
        return cameras[0].scaled(self.width)


def _peak_bytes() -> int | None:
    """The largest resident size so far; None where the system does not tell (Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss would include what started this process
        found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text())
        return 1024 * int(found[1]) if found else None
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS
