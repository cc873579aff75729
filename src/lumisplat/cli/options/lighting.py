"""Options of light: what lights the scene, its shadows, and how bright pictures come out."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.options.command import Flag
from lumisplat.cli.options.settings import Changes, setting, without_none
from lumisplat.cli.options.up import say_guessed_up

_log = logging.getLogger("lumisplat")

_LIGHTING = {"auto": None, "on": True, "off": False}


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Settings of `lumisplat.RenderConfig` and `lumisplat.ShadowConfig`, an environment, and the exposure."""

    lighting: Annotated[Literal["auto", "on", "off"] | None, setting("{auto,on,off}", "auto")] = None
    """auto: lit if the scene has lights; meshes alone are lit by a headlight at the camera. on: captures, too. off:
    captures as trained, meshes in their flat colours."""
    shadows: Annotated[Literal["off", "hard", "soft"] | None, setting("{off,hard,soft}", "hard")] = None
    """soft: lights that have a size cast penumbrae, which --samples make smooth. off: light passes through
    everything. Paths and frames in real time have soft ones instead of hard ones."""
    shadow_method: Annotated[
        Literal["exact", "first-hits", "stochastic"] | None, setting("{exact,first-hits,stochastic}", "exact")
    ] = None
    """How Gaussians block light. exact: all that are in the way. first-hits: the nearest --shadow-hits only, faster
    and at times too bright. stochastic: each ray is blocked or not, by chance: grainy, --samples average it; faster
    only where light is lost gradually."""
    shadow_hits: Annotated[Literal[4, 8, 16, 32] | None, setting("{4,8,16,32}", "16")] = None
    """Gaussians that first-hits counts."""
    shadow_offset: Annotated[float | None, setting("0..100", "4.0")] = None
    """A splat surface is not shadowed by Gaussians nearer than this many times their size or its own: raise it
    against specks, lower it where contact shadows are missing."""
    shadow_offset_absolute: Annotated[float | None, setting("UNITS", "0.0")] = None
    """Added to that, in units of the scene."""
    shadow_threshold: Annotated[float | None, setting("0..0.99", "0.0")] = None
    """What lets through less light than this counts as opaque: harder, darker shadows."""
    shadow_color: Annotated[float | None, setting("0..5", "0.0")] = None
    """How much partial shadows take on the colour of what is in the way: stained glass."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("{none,neutral,agx}", "none")] = None
    """How lit frames become pictures. none: what is too bright is clipped. neutral: highlights compressed, colours
    true. agx: as film. What only shows a capture stays as captured."""
    exposure: Annotated[float | None, arg(metavar="STOPS", help_behavior_hint="")] = None
    """Of lit pictures: 1 is twice as bright, -1 half. Without: the camera's own, else 0."""
    capture_gain: Annotated[float | Literal["auto"] | None, setting("STOPS", "0.0")] = None
    """Brighten the light that captures shine onto what is added, not the captures themselves. auto: as the surfaces
    around it show that there was."""
    denoise: Flag = False
    """Remove the noise of the light (Open Image Denoise; pip install 'lumisplat[denoise]'): fewer samples do. Captures
    that keep their look stay as captured."""
    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Light from everywhere by a latitude-longitude image, .hdr or .exr, in place of the scene's own. It stands
    upright as --up says."""
    environment_rotation: Annotated[float | None, setting("DEGREES", "0")] = None
    """Turns --environment about the vertical, counter-clockwise seen from above."""

    def changes(self) -> Changes:
        """The settings that were given."""
        shadow_rays = {
            "method": self.shadow_method and ls.ShadowMethod(self.shadow_method),
            "hits": self.shadow_hits,
            "offset": self.shadow_offset,
            "offset_absolute": self.shadow_offset_absolute,
            "transmittance_threshold": self.shadow_threshold,
            "color_strength": self.shadow_color,
        }
        frame = {
            "shadows": self.shadows and ls.Shadows(self.shadows),
            "tone_map": self.tone_map and ls.ToneMap(self.tone_map),
            "capture_gain": None if self.capture_gain == "auto" else self.capture_gain,
        }
        lighting = {} if self.lighting is None else {"lighting": _LIGHTING[self.lighting]}
        return lighting | without_none(frame) | {"shadow_rays": without_none(shadow_rays)}

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
        gain = ls.estimate_capture_gain(scene, device=renderer.device)
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
        return ls.LightEnvironment(image=ls.load_radiance(self.environment), name=self.environment.stem)

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
