"""Vertex colours of glTF files, COLOR_0, that hold something else than colours."""

from __future__ import annotations

import logging

from lumisplat.constants import RIG_BLACK_COLOR, RIG_BLACK_SHARE
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray

_log = logging.getLogger("lumisplat")


def warn_black(path: PathLike, colors: FloatArray, name: str, advice: str) -> None:
    """Logs a line if vertex colours make most of a mesh black.

    Args:
        path: The file.
        colors: Linear, shape (V, 3).
        name: Of the mesh.
        advice: What to do if they are no colours.
    """
    black = float((colors.max(axis=1) < RIG_BLACK_COLOR).mean())
    if black > RIG_BLACK_SHARE:
        share = round(100.0 * black)
        _log.warning(
            "%s: COLOR_0 makes %d %% of the vertices of %r black: if it holds something else than colour, %s",
            path,
            share,
            name,
            advice,
        )
