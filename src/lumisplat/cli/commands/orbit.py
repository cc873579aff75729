"""``lumisplat orbit``: renders a turntable of a scene, or a camera path, as frames and a video."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.farm.job import FrameJob, FrameList, make_frames
from lumisplat.cli.input.loading import block_views, file_fingerprints, scene_file, scene_settings
from lumisplat.cli.input.numbers import frame_numbers
from lumisplat.cli.options.camera import parse_up
from lumisplat.cli.options.command import Flag, ViewsCommand, given_settings, own_options_first, setting
from lumisplat.cli.options.frame import FrameCommand, frame_remarks, shared_provenance
from lumisplat.cli.output.console import Report, print_stats, progress_bars
from lumisplat.cli.output.frame_folder import FrameFolder, check_video
from lumisplat.cli.output.images import check_writable, refuse_standard_output

_log = logging.getLogger("lumisplat")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Orbit(ViewsCommand, FrameCommand):
    """Render a turntable or a camera path as frames and video.

    The same command continues after an interruption, and keeps existing frames.
    Guide: docs/guide/captures.md.
    First try: lumisplat orbit garden.ply --video orbit.mp4
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes or a scene.toml; several make one scene."""
    output: Annotated[
        Path | None,
        arg(aliases=("-o",), metavar="DIR", help_behavior_hint="(default: named after the video, or orbit)"),
    ] = None
    """Write frames and orbit.json into this folder."""
    video: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Also write a video: .mp4 (pip install 'lumisplat[video]'), .gif, .webp or .apng."""
    seconds: Annotated[float, arg(metavar="SECONDS", help_behavior_hint="(default: 6)")] = 6.0
    """Set the length of the video."""
    fps: Annotated[float, arg(metavar="FPS", help_behavior_hint="(default: 25)")] = 25.0
    """Render FPS frames per second."""
    turns: Annotated[float, arg(metavar="TURNS", help_behavior_hint="(default: 1)")] = 1.0
    """Go round the scene TURNS times to the right; negative: to the left."""
    frames: Annotated[str, setting("LIST", "all")] = ""
    """Render only these frames, numbered from 0: 1-100, 1-100x2 (every second), 1,5,9, 0:48, 48:."""
    overwrite: Flag = False
    """Delete the existing frames before rendering."""

    def run(self) -> None:
        """Renders the missing frames, then the video."""
        if self.video is not None:
            check_video(self.video, self.fps)
        with progress_bars() as report:
            job = self.open_frames(report)
            fewer = "--frames, --seconds, --fps"
            lines = make_frames(job, report, overwrite=self.overwrite, video=self.video, fewer=fewer)
        print(lines)

    def open_frames(self, report: Report) -> FrameJob:
        """Checks options and files, loads the scene, and returns the frames with functions that make them.

        Args:
            report: Receives the progress.

        Raises:
            LumisplatError: An option or a file is wrong.
        """
        folder = FrameFolder.named_after(self.output, self.video, "orbit", "png", "orbit.json")
        refuse_standard_output(folder.folder)
        count = self._frame_count()
        wanted = tuple(frame_numbers("--frames", self.frames, count))
        self.viewpoint.check(None)
        along = (
            self.cameras_on_path(self.camera_path, [index / self.fps for index in range(count)])
            if self.camera_path is not None
            else []
        )
        config = self.frame_config(scene_settings(scene_file(self.scene)))
        check_writable(folder.folder)
        environment = self.light.environment_light()
        renderer = self.start_renderer(report, config, profile=self.stats)
        whole = "--lod" * self.chooses_level
        lit, up = environment is not None, self.viewpoint.upright
        blocks = block_views(self.scene, config, self.lod_pixels, lit=lit, whole=whole, upright=up)
        scene = blocks.preview if blocks else self.load_scene(self.scene, report, given_up=parse_up(self.viewpoint.up))
        scene = self.light.lit_scene(scene, environment)
        config = self.light.with_capture_gain(renderer, config, scene)
        cameras = along or self._turntable_cameras(scene, count)
        for line in frame_remarks(config, scene, dict(given_settings(self)), self.light, device=self.device):
            _log.warning("%s", line)
        source = self.frame_source(renderer, blocks=blocks)
        frames = FrameList(
            folder=folder,
            provenance=self._provenance(config, renderer.device, folder.folder),
            wanted=wanted,
            fps=self.fps,
            in_sequence=config.pipeline.is_sequence,
        )
        return FrameJob(
            frames=frames,
            render=lambda index, report: source.frame(scene, cameras[index], report),
            write=lambda frame, index: frame.save(folder.path(index)),
            summarise=(lambda frame, _: print_stats(frame, config.pipeline)) if self.stats else None,
        )

    def _turntable_cameras(self, scene: ls.Scene, count: int) -> list[ls.Camera]:
        """Returns ``count`` cameras on a horizontal circle around the scene; together they make ``--turns`` turns."""
        start, target = self.viewpoint_camera(scene, all_around=True), self.viewpoint.target_point(scene)
        return ls.orbit_cameras(scene, count, start, turns=self.turns, target=target)

    def _frame_count(self) -> int:
        """Returns the number of frames: ``--seconds`` times ``--fps``, rounded."""
        for option, value in (("--seconds", self.seconds), ("--fps", self.fps)):
            if not 0.0 < value < math.inf:
                raise ls.ConfigError(f"{option} is {value:g}, expected a positive number")
        if not math.isfinite(self.turns):
            raise ls.ConfigError(f"--turns is {self.turns}, expected a number")
        if self.seconds * self.fps > 1e6:
            raise ls.ConfigError(f"--seconds {self.seconds:g} at --fps {self.fps:g} are more than a million frames")
        return max(1, round(self.seconds * self.fps))

    def _provenance(self, config: ls.RenderConfig, device: str, folder: Path) -> dict[str, str]:
        """Returns everything that the frames depend on, as text by name: version, device, settings, file fingerprints.

        A later run continues with existing frames only if these values are equal.
        """
        files = [*self.scene, *(path for path in (self.camera_path, self.light.environment) if path is not None)]
        chosen = (
            "seconds",
            "fps",
            "turns",
            "width",
            "height",
            "drop_invalid",
            "lod",
        )
        return {
            "lumisplat": ls.__version__,
            "device": device,
            "scene": " ".join(map(str, self.scene)),
            **{name: f"{getattr(self, name)}" for name in chosen},
            **shared_provenance(self, config),
            **file_fingerprints(files, folder),
        }
