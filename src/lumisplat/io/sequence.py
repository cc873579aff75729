"""Folders of Gaussian frames."""

from __future__ import annotations

from lumisplat.io.source import PathLike
from lumisplat.scene.sequence import GaussianSequence


def read_sequence(folder: PathLike, fps: float, drop_invalid: bool = False) -> GaussianSequence:
    """As `lumisplat.io.load_sequence`."""
    raise NotImplementedError
