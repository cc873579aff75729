"""Options of the commands that render frames of a scene: cameras, settings, rays and light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.options.command import DeviceCommand, Flag, LoadingCommand
from lumisplat.cli.options.lens import LensGroup, LensOptions
from lumisplat.cli.options.lighting import LightGroup, LightOptions
from lumisplat.cli.options.rays import PipelineName, RayGroup, RayOptions
from lumisplat.cli.options.settings import Changes, changed_config, setting, without_none
from lumisplat.cli.options.up import say_guessed_up
from lumisplat.cli.options.viewpoint import ViewpointGroup, ViewpointOptions
from lumisplat.cli.output.frame_folder import flat_settings
from lumisplat.cli.output.frame_source import FrameSource, SceneOfViews, WarmUp


@dataclass(frozen=True, kw_only=True)
class FrameCommand(LoadingCommand, DeviceCommand):
    """Options of the commands that render frames."""

    path: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Move the camera smoothly through the cameras of this file: nerfstudio's camera_path.json, a scene.toml with
    camera keyframes, or any other camera file, one second from each camera to the next."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid,path,realtime}", "raster")] = None
    """raster: fast. trace: rays, exact through Gaussians, with mirrors, glass and fisheye cameras. hybrid: rasterised,
    and rays from there on for mirrors, glass and shadows. path: light that bounces, and captures that light what
    stands in them; grainy, --samples average it. realtime: a sequence of rasterised frames in which light bounces."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; alone, it keeps the camera's aspect ratio."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image height; alone, it keeps the camera's aspect ratio."""
    crease_angle: Annotated[float | None, setting("DEGREES", "51.6")] = None
    """Of OBJs without normals: faces that meet at less are shaded smoothly; 0: flat."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """transparent, a name such as white, #rrggbb, or r,g,b in 0..1. An EXR is without one."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    viewpoint: ViewpointGroup = field(default_factory=ViewpointOptions)
    """A camera of your own, in place of those of files: lumisplat render garden.ply --azimuth 30 --elevation 20"""
    lens: LensGroup = field(default_factory=LensOptions)
    """Of --pipeline trace and path, with --samples: lumisplat render garden.ply --pipeline trace --samples 32
    --aperture 0.05 --focus 640,360 -o view.png"""
    rays: RayGroup = field(default_factory=RayOptions)
    """Of --pipeline trace, hybrid and path; --samples, --time, --noise and --seed also of lit frames. With mirrors and
    glass, smooth edges and little noise: lumisplat render scene.toml --pipeline trace --samples 16 -o view.png"""
    light: LightGroup = field(default_factory=LightOptions)
    """Lights are those of a scene.toml and of glTF files. Soft shadows and an environment, filmic:
    lumisplat render scene.toml --environment sky.hdr --shadows soft --samples 32 --tone-map agx -o view.png"""

    @property
    def crease_radians(self) -> float | None:
        """As `LoadingCommand.crease_radians`, as the option says.

        Raises:
            ConfigError: It is out of range.
        """
        if self.crease_angle is None:
            return None
        if not 0.0 <= self.crease_angle <= 180.0:
            raise ls.ConfigError(f"--crease-angle is {self.crease_angle:g}, expected 0 to 180 degrees")
        return math.radians(self.crease_angle)

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
        self.lens.pixel()
        own: Changes = {}
        if self.pipeline is not None:
            own["pipeline"] = ls.Pipeline(self.pipeline)
        if self.background is not None:
            own["background"] = self.background
        config = changed_config(base, *changes, own, self.rays.changes(), self.light.changes())
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
        return FrameSource(
            renderer, self.lens.aperture, self.lens.pixel(), self.light.denoise, warm_up or WarmUp(), blocks
        )

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

    def camera_path(self, path: Path, cameras: Path | None = None) -> ls.CameraPath:
        """The way of --path.

        Args:
            path: The file of --path.
            cameras: The file of --cameras.

        Raises:
            ConfigError: There are other cameras, too.
            FormatError: The file cannot be read.
        """
        self.viewpoint.check(cameras)
        if cameras is not None or self.viewpoint.is_given:
            other = "--cameras" if cameras is not None else "a viewpoint of your own"
            raise ls.ConfigError(f"--path and {other} are both given: choose one")
        return ls.load_camera_path(path, width=self.width, height=self.height)

    def cameras_along(self, path: Path, times: Sequence[float]) -> list[ls.Camera]:
        """The cameras of --path at the times of frames, over which all of the path is spread."""
        way = self.camera_path(path)
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
        **dict(flat_settings("lens.", command.lens)),
        **dict(flat_settings("", config)),
    }
