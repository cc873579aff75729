"""Options of the commands that render frames of a scene: cameras, settings, rays and light."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.input.up_axis import UpOption
from lumisplat.cli.options.command import DeviceCommand, Flag, LoadingCommand
from lumisplat.cli.options.lighting import LightGroup, LightOptions
from lumisplat.cli.options.rays import PipelineName, RayGroup, RayOptions
from lumisplat.cli.options.settings import Changes, changed_config, parse_background, setting


@dataclass(frozen=True, kw_only=True)
class FrameCommand(LoadingCommand, DeviceCommand):
    """Options of the commands that render frames."""

    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """transforms.json (nerfstudio), cameras.json (INRIA), or a glTF or scene.toml with cameras. Without: those of the
    scene.toml that is rendered, else one that shows all of the scene from the front."""
    up: UpOption = "auto"
    """Which way is up without cameras, and for --environment; auto: y-down with a capture, y-up for meshes alone."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid}", "raster")] = None
    """raster: fast. trace: rays, exact through Gaussians, with mirrors, glass and fisheye cameras. hybrid: rasterised,
    and rays from there on for mirrors, glass and shadows."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image width; alone, it keeps the camera's aspect ratio."""
    height: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Image height; alone, it keeps the camera's aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """black, white, transparent, #rrggbb, or r,g,b in 0..1. An EXR is without one."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    rays: RayGroup = field(default_factory=RayOptions)
    """Of --pipeline trace and hybrid; --samples and --seed also of lit frames. With mirrors and glass, smooth edges and
    little noise: lumisplat render scene.toml --pipeline trace --samples 16 -o view.png"""
    light: LightGroup = field(default_factory=LightOptions)
    """Lights are those of a scene.toml and of glTF files. Soft shadows and an environment, filmic:
    lumisplat render scene.toml --environment sky.hdr --shadows soft --samples 32 --tone-map agx -o view.png"""

    def frame_config(self, base: ls.RenderConfig, *changes: Changes) -> ls.RenderConfig:
        """The settings of a scene file, with those that were given in their place.

        Args:
            base: The settings of the file, or the defaults.
            changes: What a command changes besides.

        Raises:
            ConfigError: A value is out of its range.
        """
        own: Changes = {}
        if self.pipeline is not None:
            own["pipeline"] = ls.Pipeline(self.pipeline)
        if self.background is not None:
            own["background"] = parse_background(self.background)
        return changed_config(base, *changes, own, self.rays.changes(), self.light.changes())

    def load_cameras(self, scene_file: Path | None) -> list[ls.Camera]:
        """The cameras of --cameras, else of a scene file; none if neither has any.

        Raises:
            FormatError: The file cannot be read, or --cameras has none.
        """
        path = self.cameras or scene_file
        if path is None:
            return []
        cameras = ls.load_cameras(path, width=self.width, height=self.height)
        if not cameras and self.cameras is not None:
            raise ls.FormatError(path, "has no cameras")
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in cameras]

    def front_camera(self, scene: ls.Scene, *files: Path) -> ls.Camera:
        """A camera that shows all of a scene, loaded from ``files``, from the front.

        Raises:
            SceneError: The scene is empty, or too large; names the files.
        """
        from lumisplat.cli.input.framing import framing_camera

        try:
            if self.width is not None and self.height is not None:
                camera = framing_camera(scene, self.up, self.width, self.height)
            else:
                camera = framing_camera(scene, self.up).scaled(self.width, self.height)
        except ls.SceneError as error:
            raise ls.SceneError(f"{', '.join(map(str, files))}: {error}") from None
        return self.light.exposed(camera)
