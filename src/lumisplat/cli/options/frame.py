"""Options of the commands that render frames of a scene: cameras, settings, rays and light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.options.camera import CameraGroup, CameraOptions, say_guessed_up
from lumisplat.cli.options.command import DeviceCommand, Flag, LoadingCommand
from lumisplat.cli.options.lighting import EnvironmentGroup, EnvironmentOptions
from lumisplat.cli.options.settings import CREASE, Changes, SamplesCommand, setting, without_none
from lumisplat.cli.output.frame_folder import flat_settings
from lumisplat.cli.output.frame_source import FrameSource, SceneOfViews, WarmUp


@dataclass(frozen=True, kw_only=True)
class FrameCommand(LoadingCommand, DeviceCommand, SamplesCommand):
    """Options of the commands that render frames."""

    camera_path: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Move the camera through the cameras of this file, one second each."""
    width: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image width; alone, it keeps the aspect ratio."""
    height: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image height; alone, it keeps the aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Fill the background: transparent, a name, #rrggbb, or r,g,b in 0..1."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    viewpoint: CameraGroup = field(default_factory=CameraOptions)
    """A camera of your own: lumisplat render garden.ply --azimuth 30 --elevation 20"""
    light: EnvironmentGroup = field(default_factory=EnvironmentOptions)
    """Beside the lights of files: lumisplat render scene.toml --environment sky.hdr --shadows soft"""

    @property
    def crease_radians(self) -> float | None:
        """As `LoadingCommand.crease_radians`, as --set says.

        Raises:
            ConfigError: It is out of range.
        """
        text = self.set_values(CREASE).get(CREASE)
        try:
            degrees = math.nan if text is None else float(text)
        except ValueError:
            degrees = -1.0
        if not 0.0 <= degrees <= 180.0 and text is not None:
            raise ls.ConfigError(f"--set {CREASE}={text}: expected 0 to 180 degrees")
        return None if text is None else math.radians(degrees)

    def frame_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """The settings of a scene file, with those that were given in their place.

        Args:
            base: The settings of the file, or the defaults.
            changes: What a command changes besides.

        Raises:
            ConfigError: A value is out of its range, or --focus is no pixel.
            MissingExtraError: --denoise is given, and its package is not installed.
            SceneError: The size of the image is.
        """
        self._check_size()
        self.viewpoint.pixel()
        own = without_none({"background": self.background})
        config = self.pipeline_config(base, *changes, own, self.light.changes())
        if not self.light.denoise:
            return config
        ls.Frame.check_denoiser()
        return replace(config, aovs=(*config.aovs, "albedo"))

    def frame_source(
        self, renderer: ls.Renderer, warm_up: WarmUp | None = None, blocks: SceneOfViews | None = None
    ) -> FrameSource:
        """What renders the frames of the command.

        Args:
            renderer: Renders them.
            warm_up: Of ``--pipeline realtime``; None: of a sequence.
            blocks: In place of scenes, what each camera sees of a capture in blocks.

        Raises:
            ConfigError: --focus is no pixel.
        """
        lens = self.viewpoint
        return FrameSource(renderer, lens.aperture, lens.pixel(), self.light.denoise, warm_up or WarmUp(), blocks)

    def _check_size(self) -> None:
        """Refuses sizes that no camera has, before files are loaded and named as the ones to blame."""
        given = without_none({"width": self.width, "height": self.height})
        ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), **given)

    def load_cameras(self, cameras: Path | None, scene_file: Path | None) -> list[ls.Camera]:
        """The cameras of --cameras, else of a scene file; none if neither has any, or a viewpoint is given.

        Args:
            cameras: The camera file that was given.
            scene_file: The scene.toml that is rendered.

        Raises:
            ConfigError: The options of the viewpoint contradict themselves.
            FormatError: The file cannot be read, or --cameras has none.
        """
        path = cameras or scene_file
        self.viewpoint.check(cameras)
        if path is None or self.viewpoint.is_given:
            return []
        loaded = ls.load_cameras(path, width=self.width, height=self.height)
        if not loaded and cameras is not None:
            raise ls.FormatError(path, "has no cameras")
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in loaded]

    def load_camera_path(self, path: Path, cameras: Path | None = None) -> ls.CameraPath:
        """The way of --camera-path.

        Args:
            path: The file of --camera-path.
            cameras: The file of --cameras.

        Raises:
            ConfigError: There are other cameras, too.
            FormatError: The file cannot be read.
        """
        self.viewpoint.check(cameras)
        if cameras is not None or self.viewpoint.is_given:
            other = "--cameras" if cameras is not None else "a viewpoint of your own"
            raise ls.ConfigError(f"--camera-path and {other} are both given: choose one")
        return ls.io.load_camera_path(path, width=self.width, height=self.height)

    def cameras_along(self, path: Path, times: Sequence[float]) -> list[ls.Camera]:
        """The cameras of --camera-path at the times of frames, over which all of the path is spread."""
        way = self.load_camera_path(path)
        stretched = way.stretched(float(times[-1])) if times[-1] > 0.0 else way
        along = (stretched.at(float(time)) for time in times)
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]

    def own_camera(self, scene: ls.Scene, *files: Path, all_around: bool = False) -> ls.Camera:
        """The camera of the viewpoint; without its options, as of `lumisplat.frame_camera`.

        Args:
            scene: What it looks at.
            *files: Where it was loaded from.
            all_around: As of `lumisplat.frame_camera`.

        Raises:
            SceneError: The scene is empty, or too large; names the files.
        """
        if self.light.environment is None:  # else it is said already
            say_guessed_up(scene)
        try:
            camera = self.viewpoint.camera(scene, self.width, self.height, all_around=all_around)
        except ls.SceneError as error:
            raise ls.SceneError(f"{', '.join(map(str, files))}: {error}" if files else str(error)) from None
        return self.light.exposed(camera)


def shared_origin(command: FrameCommand, config: ls.RenderConfig) -> dict[str, str]:
    """What frames follow from of the options that all of these commands have."""
    return {
        "exposure": f"{command.light.exposure}",
        "denoise": f"{command.light.denoise}",
        "environment_rotation": f"{command.light.environment_rotation}",
        **dict(flat_settings("viewpoint.", command.viewpoint)),
        "crease_angle": f"{command.crease_radians}",
        **dict(flat_settings("", config)),
    }
