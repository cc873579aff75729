"""The option that says which way is up: few files do."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.input.numbers import vector
from lumisplat.cli.output.console import spoken_up

_log = logging.getLogger("lumisplat")

UpOption = Annotated[str, arg(metavar="AXIS|X,Y,Z", help_behavior_hint="(default: auto)")]
"""An axis such as ``y-down``, a direction, or ``auto``."""


def upright(scene: ls.Scene, up: str) -> ls.Scene:
    """The scene, with up as the option says.

    Raises:
        ConfigError: The option is no direction.
    """
    direction = parse_up(up)
    return scene if direction is None else replace(scene, up=direction)


def say_guessed_up(scene: ls.Scene) -> None:
    """Logs a line if which way is up in a scene with captures is a guess, for those who use it."""
    if scene.splats and scene.up_source == "guess":
        said = "which way is up, no file says: %s is a guess; --up says it, lumisplat convert --level finds it"
        _log.warning(said, spoken_up(scene.up_direction))


def parse_up(text: str) -> str | tuple[float, float, float] | None:
    """Up as `lumisplat.Scene` takes it; None: the scene's own.

    Raises:
        ConfigError: It is no direction.
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
