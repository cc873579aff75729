"""Options of a camera: position, target, up direction and lens."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.input.numbers import numbers, vector
from lumisplat.cli.options.command import given_options, setting
from lumisplat.cli.output.console import up_name

_log = logging.getLogger("lumisplat")

_WIDTH, _HEIGHT = 1280, 720

UpOption = Annotated[str, arg(metavar="AXIS|X,Y,Z", help_behavior_hint="(default: auto)")]
"""Up direction: an axis such as ``y-down``, a vector, or ``auto``."""


@dataclass(frozen=True, kw_only=True)
class ViewpointOptions:
    """Options of a viewpoint, the arguments of `lumisplat.Camera.look_at` and `lumisplat.frame_camera`."""

    eye: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Look from this point."""
    target: Annotated[str | None, setting("X,Y,Z", "the first view's, or the centre")] = None
    """Look at this point."""
    azimuth: Annotated[float | None, setting("DEG", "0")] = None
    """Look from this side: 0 front or the capture's first view, 90 right, 180 back."""
    elevation: Annotated[float | None, setting("DEG", "the first view's, or 11.5")] = None
    """Look from this angle above the horizon, -90 to 90."""
    distance: Annotated[float | None, setting("UNITS", "the first view's, or to fit the scene")] = None
    """Look from this distance to the target."""
    fov: Annotated[float | None, setting("DEG", "the first view's, or 45.8")] = None
    """Set the vertical field of view, 0 to 180."""
    up: UpOption = "auto"
    """Set the up direction: y-up, y-down, z-up ..., or a vector."""

    @property
    def is_given(self) -> bool:
        """True if the user gave an option that sets the camera; ``--up`` alone does not."""
        return bool(self._given())

    def check(self, cameras: Path | None) -> None:
        """Checks the options for contradictions and ranges, before files are loaded.

        Args:
            cameras: Camera file of ``--cameras``; None without one.

        Raises:
            ConfigError: Two options exclude each other, or a value is not a number or out of range.
        """
        given = self._given()
        if given and cameras is not None:
            raise ls.ConfigError(
                f"--cameras and {given[0]} are both given: choose the file's cameras or one of your own"
            )
        around = [option for option in given if option in ("--azimuth", "--elevation", "--distance")]
        if self.eye is not None and around:
            raise ls.ConfigError(f"--eye and {around[0]} are both given: choose the position or the side")
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
        """Returns the scene with the up direction that ``--up`` sets; unchanged for ``auto``."""
        return upright(scene, self.up)

    def camera(self, scene: ls.Scene, width: int | None, height: int | None, *, all_around: bool = False) -> ls.Camera:
        """Returns the camera that the options describe; for options not given, the values of `lumisplat.frame_camera`.

        Args:
            scene: Scene to look at, with its up direction.
            width: Image width in pixels. If only one of width and height is None, it follows from the aspect ratio
                16:9; if both are, the image has 1280 x 720 pixels.
            height: Image height in pixels; None as for the width.
            all_around: True chooses the distance so that the scene also fits the image from all other azimuths, for a
                turntable.

        Raises:
            ConfigError: ``--eye`` equals the target.
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
        """Returns the camera at ``--eye`` that looks at the target."""
        assert self.eye is not None
        eye = vector("--eye", self.eye)
        target = self.target_point(scene)
        distance = math.dist(eye, target)
        if distance == 0.0:
            raise ls.ConfigError(f"--eye is {self.eye}, which equals the target: choose another")
        vertical = sum(u * (t - e) for u, e, t in zip(scene.up_direction, eye, target, strict=True))
        up = scene.up_direction
        if abs(vertical) > (1.0 - 1e-6) * distance:  # straight up or down: the image's up is the front view's direction
            x, y, z = -ls.frame_camera(scene, elevation=0.5 * math.pi, distance=1.0).camera_from_world[1, :3]
            up = (x, y, z)
        camera = ls.Camera.look_at(eye, target, up, width=size[0], height=size[1], name="view", **self._lens())
        return replace(camera, near=min(camera.near, 1e-3 * distance))

    def _framing(self, scene: ls.Scene, size: tuple[int, int], all_around: bool) -> ls.Camera:
        """Returns the camera around the target at ``--azimuth``, ``--elevation`` and ``--distance``; see `camera`."""
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
        """Returns the world position at the image centre: ``--target``, else the target that `frame_camera` chooses."""
        if self.target is not None:
            return vector("--target", self.target)
        camera = ls.frame_camera(scene, distance=1.0)
        x, y, z = (float(value) for value in camera.eye + camera.camera_from_world[2, :3])
        return x, y, z


ViewpointGroup = Annotated[ViewpointOptions, arg(name="camera"), OmitArgPrefixes]
"""Type of a command field whose `ViewpointOptions` become options of the command, in a help group of their own."""


@dataclass(frozen=True, kw_only=True)
class CameraOptions(ViewpointOptions):
    """Options of a viewpoint, the lens radius, and the pixel that the lens focuses on."""

    aperture: Annotated[float | None, setting("UNITS", "the camera's, or 0")] = None
    """Set the lens radius (trace and path only); objects out of focus blur."""
    focus: Annotated[str | None, setting("X,Y", "the target")] = None
    """With an aperture: focus on the surface in this pixel; 0,0 is the upper left."""

    def pixel(self) -> tuple[int, int] | None:
        """Parses ``--focus`` to the column and row of a pixel; None without the option.

        Raises:
            ConfigError: The value is not two integers.
        """
        if self.focus is None:
            return None
        x, y = numbers("--focus", self.focus, 2, "320,180")
        if x != int(x) or y != int(y):
            raise ls.ConfigError(f"--focus is '{self.focus}', expected the column and the row of a pixel")
        return int(x), int(y)

    def _given(self) -> list[str]:
        return [option for option in super()._given() if option not in ("--aperture", "--focus")]


CameraGroup = Annotated[CameraOptions, arg(name="camera"), OmitArgPrefixes]
"""Type of a command field whose `CameraOptions` become options of the command, in a help group of their own."""


def upright(scene: ls.Scene, up: str) -> ls.Scene:
    """Returns the scene with its up direction replaced by the value of ``--up``.

    Args:
        scene: The scene.
        up: Value of ``--up``; ``auto`` keeps the scene's own.

    Raises:
        ConfigError: ``up`` is not a direction.
    """
    direction = parse_up(up)
    return scene if direction is None else replace(scene, up=direction)


def warn_if_up_is_guessed(scene: ls.Scene) -> None:
    """Logs a warning if a scene's up direction is a guess, as no file states it."""
    if scene.splats and scene.up_source == "guess":
        message = "up is guessed as %s, as no file states it: --up sets it, lumisplat convert --level finds it"
        _log.warning(message, up_name(scene.up_direction))


def parse_up(text: str) -> str | tuple[float, float, float] | None:
    """Converts the value of ``--up`` to the argument ``up`` of `lumisplat.Scene`; None for ``auto``.

    Raises:
        ConfigError: The value is not a direction.
    """
    if text == "auto":
        return None
    if text in ls.Scene.UP_NAMES:
        return text
    try:
        direction = vector("--up", text)
    except ls.ConfigError:
        axes = ", ".join(ls.Scene.UP_NAMES)
        raise ls.ConfigError(f"--up is '{text}', expected auto, {axes}, or a direction such as 0,-1,0.2") from None
    if not any(direction):
        raise ls.ConfigError(f"--up is '{text}', expected a direction")
    return direction
