"""Defines the options of commands that render frames: light, cameras and settings; logs which have no effect."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.options.camera import CameraGroup, CameraOptions, warn_if_up_is_guessed
from lumisplat.cli.options.command import (
    CREASE,
    Changes,
    DeviceCommand,
    Flag,
    LoadingCommand,
    SamplesCommand,
    given_options,
    setting,
    without_none,
)
from lumisplat.cli.output.frame_folder import flat_settings
from lumisplat.cli.output.frame_source import FrameSource, SceneForView, WarmUp

if TYPE_CHECKING:
    from lumisplat.scene.materials import Material


_log = logging.getLogger("lumisplat")

_LIGHTING = {"auto": None, "on": True, "off": False}


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Settings of light of `lumisplat.RenderConfig`."""

    lighting: Annotated[Literal["auto", "on", "off"] | None, setting("auto|on|off", "auto")] = None
    """Light the scene; auto: if it has lights or only meshes."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("off|hard|soft", "hard")] = None
    """Cast shadows; soft ones need several samples."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("NAME", "none")] = None
    """Map lit colours by none (clip), neutral (true hues) or agx (filmic)."""

    def changes(self) -> Changes:
        """The settings that were given."""
        frame = {
            "shadows": self.shadows and ls.Shadows(self.shadows),
            "tone_map": self.tone_map and ls.ToneMap(self.tone_map),
        }
        lighting = {} if self.lighting is None else {"lighting": _LIGHTING[self.lighting]}
        return lighting | without_none(frame)


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions(LightOptions):
    """The same, with an environment, the exposure, and what is done to the light of captures."""

    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Light the scene by a latitude-longitude image, .hdr or .exr."""
    environment_rotation: Annotated[float | None, setting("N", "0")] = None
    """Rotate the environment by N degrees about the vertical, counter-clockwise from above."""
    exposure: Annotated[float | None, setting("STOPS", "the camera's, or 0")] = None
    """Brighten lit images by so many stops."""
    capture_gain: Annotated[float | Literal["auto"] | None, setting("N|auto", "0")] = None
    """Brighten captured light on added objects by N stops."""
    denoise: Flag = False
    """Denoise lit frames; needs pip install 'lumisplat[denoise]'."""

    def changes(self) -> Changes:
        """The settings that were given."""
        gain = None if self.capture_gain == "auto" else self.capture_gain
        return super().changes() | without_none({"capture_gain": gain})

    def with_capture_gain(self, renderer: ls.Renderer, config: ls.RenderConfig, scene: ls.Scene) -> ls.RenderConfig:
        """The settings with the gain of captured light that --capture-gain auto finds; the renderer has them, too.

        Args:
            renderer: Renders the frames.
            config: Its settings.
            scene: What it shows.

        Raises:
            LumisplatError: The scene has no captured light, or nothing that it lights.
        """
        if self.capture_gain != "auto":
            return config
        gain = ls.avatars.estimate_capture_gain(scene, device=renderer.device)
        _log.info("captured light is brightened by %g stops (--capture-gain %g)", gain, gain)
        config = replace(config, capture_gain=gain)
        renderer.reconfigure(config)
        return config

    def exposed(self, camera: ls.Camera) -> ls.Camera:
        """The camera, with the exposure that was given.

        Raises:
            SceneError: The exposure is not finite.
        """
        return camera if self.exposure is None else replace(camera, exposure=self.exposure)

    def environment_light(self) -> ls.LightEnvironment | None:
        """The environment that was given, not yet rotated: its image is upright for y up. None: none was given.

        Raises:
            ConfigError: --environment-rotation is not finite, or is given without --environment.
            FormatError: The image cannot be read.
        """
        if self.environment is None:
            if self.environment_rotation is not None:
                raise ls.ConfigError("--environment-rotation turns --environment, which is missing")
            return None
        if not math.isfinite(self.environment_rotation or 0.0):
            raise ls.ConfigError(f"--environment-rotation is {self.environment_rotation}, expected degrees")
        return ls.LightEnvironment(image=ls.io.load_radiance(self.environment), name=self.environment.stem)

    def lit_scene(self, scene: ls.Scene, environment: ls.LightEnvironment | None) -> ls.Scene:
        """The scene with the given environment in place of its own.

        Args:
            scene: What was loaded. The environment stands upright in it.
            environment: From `environment_light`; None: the scene stays as it is.
        """
        if environment is None:
            return scene
        warn_if_up_is_guessed(scene)
        half = 0.5 * math.radians(self.environment_rotation or 0.0)
        w, x, y, z = scene.upright_wxyz
        c, s = math.cos(half), math.sin(half)
        # First about the image's vertical, +y, then upright: Hamilton's product with (c, 0, s, 0).
        turned = replace(environment, rotation_wxyz=(w * c - y * s, x * c - z * s, w * s + y * c, x * s + z * c))
        others = (light for light in scene.lights if not isinstance(light, ls.LightEnvironment))
        return replace(scene, lights=(*others, turned))


LightGroup = Annotated[LightOptions, arg(name="light"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""

EnvironmentGroup = Annotated[EnvironmentOptions, arg(name="light"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""


@dataclass(frozen=True, kw_only=True)
class FrameCommand(LoadingCommand, DeviceCommand, SamplesCommand):
    """Options of the commands that render frames."""

    camera_path: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Move the camera along the cameras of this file, one second each."""
    width: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image width; alone, it keeps the aspect ratio."""
    height: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image height; alone, it keeps the aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Fill the background: transparent, a name, #rrggbb, or r,g,b in 0..1."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    viewpoint: CameraGroup = field(default_factory=CameraOptions)
    """Replace the cameras of files (docs/guide/captures.md)."""
    light: EnvironmentGroup = field(default_factory=EnvironmentOptions)
    """Add to the lights of files (docs/guide/light.md)."""

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
        self, renderer: ls.Renderer, warm_up: WarmUp | None = None, blocks: SceneForView | None = None
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
            scene_file: The file of the scene that may have cameras, as of `camera_file`.

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

    def cameras_on_path(self, path: Path, times: Sequence[float]) -> list[ls.Camera]:
        """The cameras of --camera-path at the times of frames, over which all of the path is spread."""
        whole = self.load_camera_path(path)
        stretched = whole.stretched(float(times[-1])) if times[-1] > 0.0 else whole
        along = (stretched.at(float(time)) for time in times)
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]

    def viewpoint_camera(self, scene: ls.Scene, *files: Path, all_around: bool = False) -> ls.Camera:
        """The camera of the viewpoint; without its options, as of `lumisplat.frame_camera`.

        Args:
            scene: What it looks at.
            *files: Where it was loaded from.
            all_around: As of `lumisplat.frame_camera`.

        Raises:
            SceneError: The scene is empty, or too large; names the files.
        """
        if self.light.environment is None:  # else it is said already
            warn_if_up_is_guessed(scene)
        try:
            camera = self.viewpoint.camera(scene, self.width, self.height, all_around=all_around)
        except ls.SceneError as error:
            raise ls.SceneError(f"{', '.join(map(str, files))}: {error}" if files else str(error)) from None
        return self.light.exposed(camera)


def shared_provenance(command: FrameCommand, config: ls.RenderConfig) -> dict[str, str]:
    """What frames follow from of the options that all of these commands have."""
    return {
        "exposure": f"{command.light.exposure}",
        "denoise": f"{command.light.denoise}",
        "environment_rotation": f"{command.light.environment_rotation}",
        **dict(flat_settings("viewpoint.", command.viewpoint)),
        "crease_angle": f"{command.crease_radians}",
        **dict(flat_settings("", config)),
    }


def frame_remarks(
    config: ls.RenderConfig,
    scene: ls.Scene,
    given: Mapping[str, str],
    light: EnvironmentOptions,
    *,
    device: str = "auto",
) -> Iterator[str]:
    """Yields lines about what has no effect, and what comes out black or in patches.

    Args:
        config: Settings of the frame.
        scene: What it shows.
        given: The settings that were given, each with the option that gives it.
        light: The options of light.
        device: As of ``--device``.
    """
    yield from unused_options(config, scene, given, light)
    yield from _unused_albedos(config, scene)
    yield from _unlit_sides(config, scene)
    yield from _captures_without_surface(config, scene, device)
    yield from _clipped_light(config, scene, light)


def unused_options(
    config: ls.RenderConfig, scene: ls.Scene, given: Mapping[str, str], light: EnvironmentOptions
) -> Iterator[str]:
    """Yields a line for each reason why options are not used; arguments as of `frame_remarks`."""
    lit = config.is_lit(by_default=scene.is_lit_by_default)
    unused = config.unused_settings(lit=lit)
    unused.pop("adaptive", None)  # refused by frames
    if config.pipeline.is_sequence:
        del unused["samples"]  # --samples are frames before the picture
    if not lit:
        unused |= dict.fromkeys(("denoise", "environment", "environment_rotation"), unused["exposure"])
    options = {option.removeprefix("--").replace("-", "_"): option for option in given_options(light)} | dict(given)
    reasons: dict[str, list[str]] = {}
    for name, option in options.items():
        if reason := unused.get(name, unused.get(name.partition(".")[0])):
            reasons.setdefault(reason, []).append(option)
    for reason, names in reasons.items():
        yield f"not used: {', '.join(names)} ({reason[0].lower()}{reason[1:].rstrip('.')})"
    if lit and config.pipeline.bounces_light and light.shadows == "hard":
        yield f"not used by --pipeline {config.pipeline.value}: --shadows hard (its shadows are soft)"


def _captures_without_surface(config: ls.RenderConfig, scene: ls.Scene, device: str) -> Iterator[str]:
    """A line for each capture that takes light or shadows, and has no surface for them."""
    if config.lighting is False or not any(light.enabled for light in scene.lights):
        return
    lit = {id(one.gaussians): one for one in scene.splats if one.shadow_catcher or one.material is not None}
    for one in lit.values():
        if (remark := ls.inverse.surface_remark(one.gaussians, device=device)) is not None:
            yield f"{one.name}: {remark}" if one.name else remark


def _unused_albedos(config: ls.RenderConfig, scene: ls.Scene) -> Iterator[str]:
    """A line if lights shine on captures that have an albedo, and show them as captured for lack of a material."""
    kept = [one for one in scene.splats if one.gaussians.albedo is not None and one.material is None]
    lights = [light for light in scene.lights if light.enabled]
    if config.lighting is not False and lights and any(not one.shadow_catcher for one in kept):
        yield (
            "captures with an albedo stay as captured without a material, whatever shines on them: material = {} of "
            "their [[splats]] in a scene.toml lights them"
        )


def _unlit_sides(config: ls.RenderConfig, scene: ls.Scene) -> Iterator[str]:
    """A line if one lamp alone lights things beside a capture, which was captured in light from everywhere.

    Whoever has set up several lamps has thought of the sides.
    """
    lights = [light for light in scene.lights if light.enabled]
    is_surrounded = any(isinstance(light, ls.LightEnvironment) for light in lights)
    bounces = config.pipeline.bounces_light  # there, the capture itself lights them
    if config.lighting is False or len(lights) != 1 or is_surrounded or not scene.splats or bounces:
        return
    relit = [splats.material for splats in scene.splats if splats.material is not None and not splats.shadow_catcher]
    surfaces = {
        "meshes": any(_needs_light(instance.mesh.material) for instance in scene.meshes),
        "relit captures": any(map(_needs_light, relit)),
    }
    dark = " and ".join(name for name, is_dark in surfaces.items() if is_dark)
    if dark:
        yield (
            f"sides of {dark} that no light reaches are black: [environment] in a scene.toml (such as intensity = 0.3, "
            "visible = false) or --environment FILE lights them from all around"
        )


def _clipped_light(config: ls.RenderConfig, scene: ls.Scene, light: EnvironmentOptions) -> Iterator[str]:
    """A line if captures alone light what is added, by light that is clipped at a display's white."""
    bounces = config.pipeline.bounces_light and config.lighting is not False
    relit = [one for one in scene.splats if one.material is not None and not one.shadow_catcher]
    has_captures = len(relit) < len(scene.splats)
    asked = config.capture_gain != 0.0 or light.capture_gain is not None
    if bounces and has_captures and (scene.meshes or relit) and not scene.lights and not asked:
        yield (
            "captured light alone shines on what is added, and is clipped at a display's white: --capture-gain auto "
            "(capture_gain of [render] in a scene.toml, in stops) exposes it as its surroundings"
        )


def _needs_light(material: Material) -> bool:
    """Whether a surface is black where no light reaches it: mirrors and glass show something else."""
    own = material.emissive + (material.ambient if isinstance(material, ls.MaterialSimple) else ())
    return not material.is_smooth and not any(own)
