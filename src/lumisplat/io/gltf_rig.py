"""Rigs of glTF files: meshes, joints and clips."""

from __future__ import annotations

from lumisplat.io.source import PathLike
from lumisplat.scene.rig import Rig


def read_rig(path: PathLike, vertex_colors: bool = True) -> Rig:
    """As `lumisplat.io.load_rig`."""
    raise NotImplementedError
