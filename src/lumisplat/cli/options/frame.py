"""Options of commands that render frames: light, cameras and image; and warnings about options without effect."""

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
    """Options that set lighting, shadows and tone map of `lumisplat.RenderConfig`."""

    lighting: Annotated[Literal["auto", "on", "off"] | None, setting("auto|on|off", "auto")] = None
    """Light the scene; auto: if it has lights or meshes, always with path and realtime."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("off|hard|soft", "hard")] = None
    """Cast no, hard or soft shadows; path and realtime cast soft ones for hard, too."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("NAME", "none")] = None
    """Tone-map lit colours by none (clips), neutral (preserves hues) or agx (filmic)."""

    def changes(self) -> Changes:
        """Returns changes of the render settings, one for each option of this group that was given."""
        frame = {
            "shadows": self.shadows and ls.Shadows(self.shadows),
            "tone_map": self.tone_map and ls.ToneMap(self.tone_map),
        }
        lighting = {} if self.lighting is None else {"lighting": _LIGHTING[self.lighting]}
        return lighting | without_none(frame)


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions(LightOptions):
    """Light options, with an environment image, exposure, gain of captured light, shadow catchers and denoising."""

    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Light meshes and captures with a material by this latitude-longitude image, .hdr or .exr."""
    environment_rotation: Annotated[float | None, setting("N", "0")] = None
    """Rotate the environment by N degrees about the vertical, counter-clockwise from above."""
    exposure: Annotated[float | None, setting("STOPS", "the camera's, or 0")] = None
    """Brighten lit images by this many stops."""
    capture_gain: Annotated[float | Literal["auto"] | None, setting("N|auto", "0")] = None
    """Brighten captured light on added objects by N stops; auto: estimate N from the scene."""
    shadow_catcher: Flag = False
    """Show the shadows of added objects on captures, except on relit ones."""
    denoise: Flag = False
    """Denoise lit frames; needs pip install 'lumisplat[denoise]'."""

    def changes(self) -> Changes:
        """Returns changes of the render settings, one for each option of this group that sets one."""
        gain = None if self.capture_gain == "auto" else self.capture_gain
        return super().changes() | without_none({"capture_gain": gain})

    def with_capture_gain(self, renderer: ls.Renderer, config: ls.RenderConfig, scene: ls.Scene) -> ls.RenderConfig:
        """For ``--capture-gain auto``, estimates the gain, sets it in the renderer and returns the new settings.

        Args:
            renderer: Renderer of the frames.
            config: Settings of the renderer; returned unchanged if ``--capture-gain`` is a number or not given.
            scene: Scene of the frames.

        Raises:
            LumisplatError: The scene has no captured light, or nothing that captured light illuminates.
        """
        if self.capture_gain != "auto":
            return config
        gain = ls.avatars.estimate_capture_gain(scene, device=renderer.device)
        _log.warning("captured light is brightened by %g stops (--capture-gain %g)", gain, gain)
        config = replace(config, capture_gain=gain)
        renderer.reconfigure(config)
        return config

    def exposed(self, camera: ls.Camera) -> ls.Camera:
        """Returns the camera with its exposure replaced by ``--exposure``, stops; unchanged without the option.

        Raises:
            SceneError: The exposure is not finite.
        """
        return camera if self.exposure is None else replace(camera, exposure=self.exposure)

    def environment_light(self) -> ls.LightEnvironment | None:
        """Loads the image of ``--environment`` as a light whose +y is up, not yet rotated; None without the option.

        Raises:
            ConfigError: ``--environment-rotation`` is not finite, or is given without ``--environment``.
            FormatError: The image cannot be read.
        """
        if self.environment is None:
            if self.environment_rotation is not None:
                raise ls.ConfigError("--environment-rotation needs --environment")
            return None
        if not math.isfinite(self.environment_rotation or 0.0):
            raise ls.ConfigError(f"--environment-rotation is {self.environment_rotation}, expected degrees")
        return ls.LightEnvironment(image=ls.io.load_radiance(self.environment), name=self.environment.stem)

    def lit_scene(self, scene: ls.Scene, environment: ls.LightEnvironment | None) -> ls.Scene:
        """Returns a scene with ``--environment`` as its only environment, and with the shadow catchers of the options.

        The environment is turned to the scene's up direction and by ``--environment-rotation``.

        Args:
            scene: The loaded scene.
            environment: Light from `environment_light`; None keeps the lights of the scene.
        """
        if self.shadow_catcher:
            catchers = (replace(one, shadow_catcher=one.material is None or one.shadow_catcher) for one in scene.splats)
            scene = replace(scene, splats=tuple(catchers))
        if environment is None:
            return scene
        warn_if_up_is_guessed(scene)
        half = 0.5 * math.radians(self.environment_rotation or 0.0)
        w, x, y, z = scene.upright_wxyz
        c, s = math.cos(half), math.sin(half)
        # Rotates about the image's vertical, +y, first: Hamilton's product upright * (c, 0, s, 0).
        rotated = replace(environment, rotation_wxyz=(w * c - y * s, x * c - z * s, w * s + y * c, x * s + z * c))
        others = (light for light in scene.lights if not isinstance(light, ls.LightEnvironment))
        return replace(scene, lights=(*others, rotated))


LightGroup = Annotated[LightOptions, arg(name="light"), OmitArgPrefixes]
"""Type of a command field whose `LightOptions` become options of the command, in a help group of their own."""

EnvironmentGroup = Annotated[EnvironmentOptions, arg(name="light"), OmitArgPrefixes]
"""Type of a command field whose `EnvironmentOptions` become options of the command, in a help group of their own."""


@dataclass(frozen=True, kw_only=True)
class FrameCommand(LoadingCommand, DeviceCommand, SamplesCommand):
    """Base class of commands that render frames."""

    camera_path: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Move the camera along this file's cameras; render: at its times, or one a second."""
    width: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image width (1280 without cameras); alone, it keeps the aspect ratio."""
    height: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image height (720 without cameras); alone, it keeps the aspect ratio."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Fill the background: transparent, a name, #rrggbb, or r,g,b in 0..1."""
    stats: Flag = False
    """Print times, counts and memory of the last frame."""
    viewpoint: CameraGroup = field(default_factory=CameraOptions)
    """Set the camera, in place of those of the files (docs/guide/captures.md)."""
    light: EnvironmentGroup = field(default_factory=EnvironmentOptions)
    """Set light and shadows (docs/guide/light.md)."""

    @property
    def crease_radians(self) -> float | None:
        """Value of ``--set meshes.crease_angle_degrees`` in radians; None without it.

        Mesh edges with a larger angle between their faces stay sharp.

        Raises:
            ConfigError: The angle is out of range.
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
        """Returns the render settings: those of a scene file, changed by all options of the command.

        Args:
            base: Settings of the file, or the defaults.
            changes: Further changes; options override them.

        Raises:
            ConfigError: A value is out of range, or ``--focus`` is not a pixel.
            MissingExtraError: ``--denoise`` is given, and its package is not installed.
            SceneError: The image size is out of range.
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
        """Returns an object that renders the command's frames, and focuses and denoises them as options ask.

        Args:
            renderer: Renders the frames.
            warm_up: Number of frames of the realtime pipeline to render before one is kept; None warms up once, before
                the first frame of a sequence.
            blocks: Loads the blocks of a capture that a camera sees; None if scenes are loaded whole.

        Raises:
            ConfigError: ``--focus`` is not a pixel.
        """
        lens = self.viewpoint
        return FrameSource(renderer, lens.aperture, lens.pixel(), self.light.denoise, warm_up or WarmUp(), blocks)

    def _check_size(self) -> None:
        """Raises a SceneError if ``--width`` or ``--height`` is out of range; call it before files are loaded."""
        given = without_none({"width": self.width, "height": self.height})
        ls.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), **given)

    def load_cameras(self, cameras: Path | None, scene_file: Path | None) -> list[ls.Camera]:
        """Returns the cameras of ``--cameras``, else of the scene file, with the size and exposure of the options.

        The list is empty if neither has cameras, or if a viewpoint option such as ``--eye`` is given.

        Args:
            cameras: File of ``--cameras``; None without it.
            scene_file: File of the scene that may have cameras, from `camera_file`.

        Raises:
            ConfigError: Viewpoint options contradict each other.
            FormatError: The file cannot be read, or the file of ``--cameras`` has no cameras.
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
        """Loads the camera path of ``--camera-path``, which interpolates between the cameras of a file.

        Args:
            path: File of ``--camera-path``.
            cameras: File of ``--cameras``, which excludes a camera path; None without it.

        Raises:
            ConfigError: Other cameras are given, too.
            FormatError: The file cannot be read.
        """
        self.viewpoint.check(cameras)
        if cameras is not None or self.viewpoint.is_given:
            other = "--cameras" if cameras is not None else "a viewpoint of your own"
            raise ls.ConfigError(f"--camera-path and {other} are both given: choose one")
        return ls.io.load_camera_path(path, width=self.width, height=self.height)

    def cameras_on_path(self, path: Path, times: Sequence[float]) -> list[ls.Camera]:
        """Returns the cameras of ``--camera-path`` at times in seconds, after stretching the path to the last time."""
        whole = self.load_camera_path(path)
        stretched = whole.stretched(float(times[-1])) if times[-1] > 0.0 else whole
        along = (stretched.at(float(time)) for time in times)
        return [self.light.exposed(camera.scaled(self.width, self.height)) for camera in along]

    def viewpoint_camera(self, scene: ls.Scene, *files: Path, all_around: bool = False) -> ls.Camera:
        """Returns the camera that the viewpoint options describe, else a view of the whole scene, with its exposure.

        Args:
            scene: Scene to look at.
            *files: Files of the scene, for error messages.
            all_around: True chooses a distance at which the scene fits from all azimuths, for a turntable.

        Raises:
            SceneError: The scene is empty or too large; the message names the files.
        """
        if self.light.environment is None:  # otherwise lit_scene has already warned
            warn_if_up_is_guessed(scene)
        try:
            camera = self.viewpoint.camera(scene, self.width, self.height, all_around=all_around)
        except ls.SceneError as error:
            raise ls.SceneError(f"{', '.join(map(str, files))}: {error}" if files else str(error)) from None
        return self.light.exposed(camera)


def shared_provenance(command: FrameCommand, config: ls.RenderConfig) -> dict[str, str]:
    """Returns the values of all render settings, and of `FrameCommand` options that affect frames, as text by name.

    A later run continues with existing frames only if these values are equal.
    """
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
    has_actors: bool = False,
) -> Iterator[str]:
    """Yields warnings about given options without effect, and about frames that will look unlit, black or too dark.

    Args:
        config: Settings of the frame.
        scene: Scene of the frame.
        given: Option that the user gave for each setting, by the setting's name.
        light: Light options.
        device: Value of ``--device``.
        has_actors: True if an `AvatarLighter` lights actors by the captures and casts their shadows on them.
    """
    yield from unused_options(config, scene, given, light)
    yield from _unlit_captures(config, scene, has_actors=has_actors)
    yield from _unlit_sides(config, scene)
    yield from _captures_without_surface(config, scene, device)
    yield from _clipped_light(config, scene, light)


def unused_options(
    config: ls.RenderConfig, scene: ls.Scene, given: Mapping[str, str], light: EnvironmentOptions
) -> Iterator[str]:
    """Yields a warning for each reason why given options have no effect, which names these options.

    Args:
        config: Settings of the frame.
        scene: Scene of the frame.
        given: Option that the user gave for each setting, by the setting's name.
        light: Light options.
    """
    lit = config.is_lit(by_default=scene.is_lit_by_default)
    unused = config.unused_settings(lit=lit)
    unused.pop("adaptive", None)  # rendering reports this setting as an error
    if config.pipeline.is_sequence:
        del unused["samples"]  # --samples counts warm-up frames
    if not lit:
        unused |= dict.fromkeys(
            ("denoise", "environment", "environment_rotation", "shadow_catcher"), unused["exposure"]
        )
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
    """Yields a warning for each relit or shadow-catching capture whose Gaussians do not lie on surfaces."""
    if config.lighting is False or not any(light.enabled for light in scene.lights):
        return
    lit = {id(one.gaussians): one for one in scene.splats if one.shadow_catcher or one.material is not None}
    for one in lit.values():
        if (remark := ls.inverse.surface_remark(one.gaussians, device=device)) is not None:
            yield f"{one.name}: {remark}" if one.name else remark


def _unlit_captures(config: ls.RenderConfig, scene: ls.Scene, *, has_actors: bool) -> Iterator[str]:
    """Yields a warning if the scene has lights, but captures without a material, which lights do not affect.

    Warns only if no capture has a material, or if a capture without one stores an albedo and could be relit.

    Args:
        config: Settings of the frame.
        scene: Scene of the frame.
        has_actors: True if actors are lit; captures as captured are then expected.
    """
    unlit = [one for one in scene.splats if one.material is None and not one.shadow_catcher]
    has_albedo = any(one.gaussians.albedo is not None for one in unlit)
    if config.lighting is False or not unlit or not any(light.enabled for light in scene.lights):
        return
    has_catcher = any(instance.shadow_catcher for instance in scene.meshes)
    if has_albedo or (len(unlit) == len(scene.splats) and not has_actors and not has_catcher):
        catch = "; --shadow-catcher shows the shadows of meshes on them" if scene.meshes and not has_actors else ""
        yield (
            "captures without a material stay as captured: material = {} of their [[splats]] in a scene.toml relights "
            f"them{catch}"
        )


def _unlit_sides(config: ls.RenderConfig, scene: ls.Scene) -> Iterator[str]:
    """Yields a warning if one light alone lights objects beside a capture, so that their unlit sides are black.

    No warning with several lights or an environment, nor with bounced light.
    """
    lights = [light for light in scene.lights if light.enabled]
    is_surrounded = any(isinstance(light, ls.LightEnvironment) for light in lights)
    bounces = config.pipeline.bounces_light  # captures then light the other sides
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
    """Yields a warning if captures are the only light on added objects: their colours are clipped at display white.

    No warning if ``--capture-gain`` or the scene file sets a gain that compensates for the missing light.
    """
    bounces = config.pipeline.bounces_light and config.lighting is not False
    relit = [one for one in scene.splats if one.material is not None and not one.shadow_catcher]
    has_captures = len(relit) < len(scene.splats)
    asked = config.capture_gain != 0.0 or light.capture_gain is not None
    if bounces and has_captures and (scene.meshes or relit) and not scene.lights and not asked:
        yield (
            "captures alone light added objects, and their light is clipped at display white: --capture-gain auto "
            "(capture_gain of [render] in a scene.toml, in stops) compensates for it"
        )


def _needs_light(material: Material) -> bool:
    """True if a material is black where no light reaches it: it is not a mirror or glass, and does not emit."""
    own = material.emissive + (material.ambient if isinstance(material, ls.MaterialSimple) else ())
    return not material.is_smooth and not any(own)
