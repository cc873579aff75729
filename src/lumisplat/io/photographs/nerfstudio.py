"""What nerfstudio's ``transforms.json`` says beside its frames: points of the scene, and which frames are for what."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.cameras.camera_json import parse_json
from lumisplat.io.cameras.json_values import Entry, is_list, is_object, quote
from lumisplat.io.files.references import referenced_file
from lumisplat.io.files.source import parsing
from lumisplat.io.photographs.listing import Listed, shortest_name
from lumisplat.io.ply.header import read_ply_header
from lumisplat.io.ply.rows import PlyRows, read_ply_element
from lumisplat.math.arrays import Doubles, FloatArray

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True)
class Splits:
    """The frames to learn from and to measure with, by their file paths; None: the file does not say."""

    training: frozenset[str] | None
    held_out: frozenset[str] | None

    @classmethod
    def of(cls, path: Path) -> Splits:
        """Those of a file: ``train_filenames``, and ``test_filenames``, else ``val_filenames``.

        Raises:
            FormatError: One of them is no list of names.
        """
        content = _content(path)
        training, test, validation = (_names(path, content, f"{part}_filenames") for part in ("train", "test", "val"))
        return cls(training, validation if test is None else test)

    def divide(self, path: Path, listed: list[Listed], *, holds_out: bool) -> tuple[list[Listed], list[Listed] | None]:
        """Frames to learn from, and to measure with; None: the file does not say which.

        Args:
            path: The file.
            listed: All of its frames.
            holds_out: Whether any are wanted to measure with.

        Raises:
            FormatError: No frame is left to learn from.
        """
        if self.training is None and self.held_out is None:
            return listed, None
        held_out = self.held_out or frozenset()
        learnt = [one for one in listed if (one.name in self.training if self.training else one.name not in held_out)]
        if not learnt:
            raise FormatError(path, "has none of the frames that its train_filenames name")
        if self.held_out is None:
            rest = [one for one in listed if one not in learnt]
        else:
            rest = [one for one in listed if one.name in held_out and one not in learnt]
        return learnt, rest if holds_out else []


def nerfstudio_points(path: Path) -> tuple[Doubles, FloatArray] | None:
    """The points of ``ply_file_path``; None: it names none, or they are not there, of which a log line tells.

    Returns:
        Positions in world space, shape (N, 3), and display-referred colours, 0..1, shape (N, 3), grey without any.

    Raises:
        FormatError: The file is damaged, or has a position that is not finite.
    """
    name = _content(path).get("ply_file_path")
    if name is None:
        return None
    file = referenced_file(path, str(name))
    if not os.path.isfile(file):
        _log.warning("%s: its ply_file_path %s is not there: training begins at random points", path, quote(name))
        return None
    with parsing(file, "points of photographs"):
        header = read_ply_header(file)
        rows = read_ply_element(header, header.required("vertex"))
        if not {"x", "y", "z"} <= set(rows.dtype.names or ()):
            raise FormatError(file, "has no x, y and z: expected points")
        positions = _columns(rows, ("x", "y", "z"))
        if not len(positions):
            return None
        if not np.isfinite(positions).all():
            raise FormatError(file, "has points whose positions are not finite")
        return positions, _colors(rows)


def _colors(rows: PlyRows) -> FloatArray:
    names = ("red", "green", "blue")
    if not set(names) <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), 0.5, np.float32)
    colors = _columns(rows, names)
    largest = 255.0 if rows.dtype["red"].kind in "iu" else 1.0
    return np.clip(colors / largest, 0.0, 1.0).astype(np.float32)


def _columns(rows: PlyRows, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _content(path: Path) -> Entry:
    with parsing(path, "a transforms.json of photographs"):
        content = parse_json(path)
    return content if is_object(content) else {}


def _names(path: Path, content: Entry, key: str) -> frozenset[str] | None:
    names = content.get(key)
    if names is None:
        return None
    if not is_list(names) or not all(isinstance(name, str) for name in names):
        raise FormatError(path, f"{key} is {quote(names)}, expected a list of the file_path of frames")
    return frozenset(shortest_name(str(name)) for name in names)
