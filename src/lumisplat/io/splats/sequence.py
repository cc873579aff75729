"""Reads sequences: folders with one file of Gaussians per frame."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from lumisplat.errors import FormatError, MissingFileError
from lumisplat.io.files.source import PathLike, readable
from lumisplat.scene.animation.actors import GaussianSequence
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import Scene

_EXTENSIONS = (".compressed.ply", ".ply", ".spz", ".sog")
"""File extensions of frames, longer ones first: a file has the first extension that its name ends with."""


def read_sequence(folder: PathLike, fps: float, load: Callable[[Path], Gaussians | Mesh | Scene]) -> GaussianSequence:
    """Opens a sequence; see `lumisplat.io.load_sequence`. ``load`` reads one frame."""
    folder = Path(folder)

    def load_frame(path: Path) -> Gaussians:
        frame = load(path)
        if not isinstance(frame, Gaussians):
            raise FormatError(path, f"is a {type(frame).__name__.lower()}, expected a frame of Gaussians")
        return frame

    sequence = GaussianSequence(_frame_paths(folder), fps, load_frame)
    sequence.at(0.0)  # reports an error that all frames have before rendering begins
    return sequence


def _frame_paths(folder: Path) -> list[Path]:
    """Lists the frame files of a folder, sorted so that numbers in names compare as numbers."""
    with readable(folder):
        if not folder.exists():
            raise MissingFileError(folder, "no such folder")
        if not folder.is_dir():
            raise FormatError(folder, "is a file, expected a folder of frames")
        files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    kinds = {path: kind for path in files if (kind := _extension(path))}
    found = sorted(set(kinds.values()))
    if not found:
        raise FormatError(folder, f"holds no frames: expected files that end in {', '.join(_EXTENSIONS)}")
    if len(found) > 1:
        raise FormatError(folder, f"holds frames in {' and '.join(found)}, expected one format")
    return sorted(kinds, key=_natural_order)


def _extension(path: Path) -> str | None:
    return next((end for end in _EXTENSIONS if path.name.lower().endswith(end)), None)


def _natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Returns a sort key that puts ``frame_2`` before ``frame_10``."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), part) if part.isdecimal() else (0, 0, part) for part in parts]
