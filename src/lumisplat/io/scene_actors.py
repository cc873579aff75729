"""Actors and the animation of a scene file."""

from __future__ import annotations

from lumisplat.io.source import PathLike
from lumisplat.scene.actors import Animation


def read_animation(path: PathLike) -> Animation:
    """As `lumisplat.io.load_animation`."""
    raise NotImplementedError
