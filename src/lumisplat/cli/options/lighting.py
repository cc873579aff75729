"""Options of light: what lights the scene, its shadows, and how bright pictures come out."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.options.camera import say_guessed_up
from lumisplat.cli.options.command import Flag
from lumisplat.cli.options.settings import Changes, setting, without_none

_log = logging.getLogger("lumisplat")

_LIGHTING = {"auto": None, "on": True, "off": False}


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Settings of light of `lumisplat.RenderConfig`."""

    lighting: Annotated[Literal["auto", "on", "off"] | None, setting("{auto,on,off}", "auto")] = None
    """Light the scene: auto if it has lights or is of meshes alone."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("{off,hard,soft}", "hard")] = None
    """Cast shadows; soft ones need samples."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("{none,neutral,agx}", "none")] = None
    """Map lit colours to the display: clipped, true or filmic."""

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
    environment_rotation: Annotated[float | None, setting("DEGREES", "0")] = None
    """Turn the environment about the vertical, counter-clockwise from above."""
    exposure: Annotated[float | None, setting("STOPS", "the camera's or 0")] = None
    """Expose lit images: 1 is twice as bright, -1 half."""
    capture_gain: Annotated[float | Literal["auto"] | None, setting("STOPS|auto", "0")] = None
    """Brighten the light of captures on what is added to them."""
    denoise: Flag = False
    """Remove the noise of lit frames; needs pip install 'lumisplat[denoise]'."""

    def changes(self) -> Changes:
        """The settings that were given."""
        gain = None if self.capture_gain == "auto" else self.capture_gain
        return super().changes() | without_none({"capture_gain": gain})

    def exposed_captures(self, renderer: ls.Renderer, config: ls.RenderConfig, scene: ls.Scene) -> ls.RenderConfig:
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
        say_guessed_up(scene)
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
