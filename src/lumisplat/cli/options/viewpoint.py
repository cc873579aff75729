"""Options of a camera of one's own: where it stands, what it looks at, and which way is up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.input.numbers import vector
from lumisplat.cli.options.settings import given_options, setting
from lumisplat.cli.options.up import UpOption, parse_up, upright

_WIDTH, _HEIGHT = 1280, 720


@dataclass(frozen=True, kw_only=True)
class ViewpointOptions:
    """Arguments of `lumisplat.Camera.look_at` and `lumisplat.frame_camera`."""

    eye: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Look from here, in place of the cameras of files."""
    target: Annotated[
        str | None, arg(metavar="X,Y,Z", help_behavior_hint="(default: what the first view sees, or the middle)")
    ] = None
    """Look at this point."""
    azimuth: Annotated[float | None, setting("DEGREES", "0")] = None
    """Look from this side instead: 0 is the first view of a capture, else the front, 90 the right, 180 the back."""
    elevation: Annotated[float | None, setting("DEGREES", "first view's or 11.5")] = None
    """From this far above the horizon, -90 to 90; 90 looks straight down."""
    distance: Annotated[float | None, setting("UNITS", "first view's or all is seen")] = None
    """From this far away from the target."""
    fov: Annotated[float | None, setting("DEGREES", "first view's or 45.8")] = None
    """Vertical field of view; less is a longer lens."""
    up: UpOption = "auto"
    """Which way is up: y-down, y-up, z-up, z-down, x-up, x-down or a direction. auto: as the scene.toml or
    the capture says, else y down with a capture, y up for meshes alone. Also for --environment."""

    @property
    def is_given(self) -> bool:
        """Whether a camera of one's own is asked for."""
        return bool(self._given())

    def check(self, cameras: Path | None) -> None:
        """Refuses what contradicts itself, before anything is loaded.

        Args:
            cameras: The camera file that was given.

        Raises:
            ConfigError: Options do not go together, or are not numbers.
        """
        given = self._given()
        if given and cameras is not None:
            raise ls.ConfigError(
                f"--cameras and {given[0]} are both given: choose the file's cameras or one of your own"
            )
        around = [option for option in given if option in ("--azimuth", "--elevation", "--distance")]
        if self.eye is not None and around:
            raise ls.ConfigError(
                f"--eye and {around[0]} are both given: one says from where, the other from which side"
            )
        for option, text in (("--eye", self.eye), ("--target", self.target)):
            if text is not None:
                vector(option, text)
        for option, degrees, largest in (("--azimuth", self.azimuth, 360.0), ("--elevation", self.elevation, 90.0)):
            if degrees is not None and not abs(degrees) <= largest:
                raise ls.ConfigError(f"{option} is {degrees:g}, expected degrees from {-largest:g} to {largest:g}")
        if self.fov is not None and not 0.0 < self.fov < 180.0:
            raise ls.ConfigError(f"--fov is {self.fov:g}, expected degrees between 0 and 180")
        if self.distance is not None and not 0.0 < self.distance < math.inf:
            raise ls.ConfigError(f"--distance is {self.distance:g}, expected a positive number of scene units")
        parse_up(self.up)

    def upright(self, scene: ls.Scene) -> ls.Scene:
        """The scene, with up as --up says."""
        return upright(scene, self.up)

    def camera(self, scene: ls.Scene, width: int | None, height: int | None, *, all_around: bool = False) -> ls.Camera:
        """The camera; without options, as of `lumisplat.frame_camera`.

        Args:
            scene: What it looks at, upright.
            width: Image width, pixels; None: that of 1280 x 720, or of its aspect ratio.
            height: Image height, pixels.
            all_around: As of `lumisplat.frame_camera`.

        Raises:
            ConfigError: --eye is at --target.
            SceneError: The scene is empty.
        """
        given = (width, height) if width is not None and height is not None else None
        size = given or (_WIDTH, _HEIGHT)
        camera = self._looking(scene, size) if self.eye is not None else self._framing(scene, size, all_around)
        return camera if given else camera.scaled(width, height)

    def _given(self) -> list[str]:
        return [option for option in given_options(self) if option != "--up"]

    def _lens(self) -> dict[str, Any]:
        return {} if self.fov is None else {"fov_y": math.radians(self.fov)}

    def _looking(self, scene: ls.Scene, size: tuple[int, int]) -> ls.Camera:
        """The camera at --eye."""
        assert self.eye is not None
        eye = vector("--eye", self.eye)
        target = self.target_point(scene)
        distance = math.dist(eye, target)
        if distance == 0.0:
            raise ls.ConfigError(f"--eye is {self.eye}, which is the target: they must be apart")
        vertical = sum(u * (t - e) for u, e, t in zip(scene.up_direction, eye, target, strict=True))
        up = scene.up_direction
        if abs(vertical) > (1.0 - 1e-6) * distance:  # along the vertical, up is where the front camera looks
            x, y, z = -ls.frame_camera(scene, elevation=0.5 * math.pi, distance=1.0).camera_from_world[1, :3]
            up = (x, y, z)
        camera = ls.Camera.look_at(eye, target, up, width=size[0], height=size[1], name="view", **self._lens())
        return replace(camera, near=min(camera.near, 1e-3 * distance))

    def _framing(self, scene: ls.Scene, size: tuple[int, int], all_around: bool) -> ls.Camera:
        """The camera at --azimuth, --elevation and --distance."""
        given = {"azimuth": self.azimuth, "elevation": self.elevation}
        angles: dict[str, Any] = {name: math.radians(value) for name, value in given.items() if value is not None}
        return ls.frame_camera(
            scene,
            distance=self.distance,
            target=None if self.target is None else vector("--target", self.target),
            width=size[0],
            height=size[1],
            all_around=all_around,
            **angles,
            **self._lens(),
        )

    def target_point(self, scene: ls.Scene) -> tuple[float, float, float]:
        """The point in the middle of the image: --target, else that of `lumisplat.frame_camera`."""
        if self.target is not None:
            return vector("--target", self.target)
        camera = ls.frame_camera(scene, distance=1.0)
        x, y, z = (float(value) for value in camera.eye + camera.camera_from_world[2, :3])
        return x, y, z


ViewpointGroup = Annotated[ViewpointOptions, arg(name="viewpoint"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""
