"""``lumisplat bench``: times the frames of a scene on this machine."""

from __future__ import annotations

import logging
import re
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import camera_file, scene_file, scene_settings, warn_of_unused_cameras
from lumisplat.cli.options.camera import ViewpointGroup, ViewpointOptions, parse_up
from lumisplat.cli.options.command import (
    DeviceCommand,
    InsertingCommand,
    PipelineCommand,
    given_settings,
    own_options_first,
    setting,
)
from lumisplat.cli.options.frame import EnvironmentOptions, unused_options
from lumisplat.cli.output.console import (
    Report,
    byte_size,
    count_rows,
    print_table,
    progress_bars,
    stage_rows,
    stage_times,
)

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True)
class _SteadyFrames:
    """Times, in milliseconds, of the frames after the first, as wholes and by render stage."""

    last: ls.Frame
    frame_ms: list[float]
    stage_ms: list[dict[str, float]]

    def stage_medians(self) -> dict[str, float]:
        """Returns the median over the frames of the time of each stage, milliseconds."""
        return {name: statistics.median(row[name] for row in self.stage_ms) for name in self.stage_ms[0]}


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Bench(InsertingCommand, DeviceCommand, PipelineCommand):
    """Time loading, the first frame and steady frames of a scene.

    Times of steady frames are medians over frames of one camera.
    Guide: docs/guide/performance.md.
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes or a scene.toml; without files, use the demo scene."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Use the first camera of this file."""
    width: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image width (1280 without cameras); the aspect ratio is kept."""
    repeats: Annotated[int, arg(metavar="N")] = 20
    """Time N frames after the first."""
    viewpoint: ViewpointGroup = field(default_factory=ViewpointOptions)
    """Set the camera with which frames are timed, in place of the cameras of the files."""

    def run(self) -> None:
        """Times loading and frames of the scene, and prints a table."""
        if self.repeats < 1:
            raise ls.ConfigError(f"--repeats is {self.repeats}, expected at least 1")
        self.viewpoint.check(self.cameras)
        config = self.pipeline_config(scene_settings(scene_file(self.scene)))
        if self.cameras is None and not self.viewpoint.is_given:
            warn_of_unused_cameras(self.scene)
        cameras_of = self.cameras or camera_file(self.scene)
        cameras = ls.load_cameras(cameras_of) if cameras_of else []
        with progress_bars() as report:
            started = time.perf_counter()
            renderer = self.start_renderer(report, config)
            ready = time.perf_counter()
            scene = self._load(report)
            scene = self.viewpoint.upright(scene)
            for line in unused_options(config, scene, dict(given_settings(self)), EnvironmentOptions()):
                _log.warning("%s", line)
            loaded = time.perf_counter()
            camera = self._camera(cameras, scene)
            renderer.render(scene, camera)
            first_ms = 1e3 * (time.perf_counter() - loaded)
            steady = self._steady_frames(renderer, scene, camera, report)
            stage_ms = steady.stage_medians() or self._profiled_stages(report, config, scene, camera)
        rows = [
            ("start, kernels", f"{1e3 * (ready - started):8.1f} ms"),
            ("load" if self.scene else "build demo", f"{1e3 * (loaded - ready):8.1f} ms"),
            ("first frame", f"{first_ms:8.1f} ms"),
            (f"frame, median of {self.repeats}", f"{statistics.median(steady.frame_ms):8.1f} ms"),
            *stage_rows(stage_ms),
            *count_rows(steady.last, config.pipeline),
        ]
        peak = _peak_bytes()
        if peak is not None:
            rows.append(("peak of the process", byte_size(peak)))
        print_table(f"{renderer.device}, {camera.width} x {camera.height}", rows)

    def _load(self, report: Report) -> ls.Scene:
        """Loads the scene of the given files; without files, builds the demo scene."""
        if not self.scene:
            return ls.demo_scene(report)
        return self.load_scene(self.scene, report, given_up=parse_up(self.viewpoint.up))

    def _steady_frames(
        self, renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera, report: Report
    ) -> _SteadyFrames:
        """Renders and times ``--repeats`` frames after the first, whose kernels are then compiled."""
        frame_ms: list[float] = []
        stage_ms: list[dict[str, float]] = []
        frame: ls.Frame | None = None
        for done in range(self.repeats):
            report("timing", done / self.repeats)
            begun = time.perf_counter()
            frame = renderer.render(scene, camera)
            assert frame.color.size  # waits for the download
            frame_ms.append(1e3 * (time.perf_counter() - begun))
            stage_ms.append(stage_times(frame))
        assert frame is not None
        return _SteadyFrames(frame, frame_ms, stage_ms)

    def _profiled_stages(
        self, report: Report, config: ls.RenderConfig, scene: ls.Scene, camera: ls.Camera
    ) -> dict[str, float]:
        """Returns the stage times of one frame, milliseconds, from a renderer with profiling.

        GPUs need profiling for stage times. It waits after each stage, so the whole frame is slower than without.
        """
        renderer = self.start_renderer(report, config, profile=True)
        renderer.render(scene, camera)
        return stage_times(renderer.render(scene, camera))

    def _camera(self, cameras: list[ls.Camera], scene: ls.Scene) -> ls.Camera:
        if self.viewpoint.is_given or not (cameras or not self.scene):
            return self.viewpoint.camera(scene, self.width, None)
        return (cameras or ls.demo_cameras())[0].scaled(self.width)


def _peak_bytes() -> int | None:
    """Returns the peak resident memory of this process, bytes; None on Windows, which does not report it."""
    status = Path("/proc/self/status")
    if status.exists():  # ru_maxrss would include the parent process
        found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text())
        return 1024 * int(found[1]) if found else None
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS
