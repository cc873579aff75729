"""Which way is up: files do not say it."""

from __future__ import annotations

import math
from typing import Literal

import lumisplat as ls

UpAxis = Literal["y-down", "y-up", "z-up"]
UpOption = Literal["auto", "y-down", "y-up", "z-up"]

_HALF = math.sqrt(0.5)
WORLD_FROM_ENVIRONMENT: dict[UpAxis, tuple[float, float, float, float]] = {
    "y-up": (1.0, 0.0, 0.0, 0.0),
    "y-down": (0.0, 1.0, 0.0, 0.0),
    "z-up": (_HALF, _HALF, 0.0, 0.0),
}
"""Rotation wxyz by which +y of an environment's image points up."""


def resolved_up(scene: ls.Scene, up: UpOption) -> UpAxis:
    """The axis that is up; ``auto`` is y-down for a scene with a capture, y-up for one of meshes alone."""
    if up == "auto":
        return "y-down" if scene.splats else "y-up"
    return up
