"""Vertex colours of glTF files, COLOR_0, that hold something else than colours."""

from __future__ import annotations

import logging

from lumisplat.constants import RIG_BLACK_COLOR, RIG_BLACK_SHARE
from lumisplat.io.files.source import PathLike
from lumisplat.math.arrays import FloatArray
from lumisplat.scene.materials import Material

_log = logging.getLogger("lumisplat")


def usable_colors(path: PathLike, colors: FloatArray, material: Material, name: str, advice: str) -> FloatArray | None:
    """Returns vertex colours, unless they make most of a textured mesh black: these are masks, and a line says so.

    Without a texture they are all the colour that there is: they are used, and the line says what to do.

    Args:
        path: The file.
        colors: Linear, shape (V, 3).
        material: Of the mesh.
        name: Of the mesh.
        advice: What to do if they are no colours.
    """
    black = float((colors.max(axis=1) < RIG_BLACK_COLOR).mean())
    if black <= RIG_BLACK_SHARE:
        return colors
    share, is_textured = round(100.0 * black), material.base_color_texture is not None
    line = "%s: COLOR_0 makes %d %% of the vertices of %r black: "
    line += "the mesh has a texture, and COLOR_0 is left out" if is_textured else f"if it is no colour, {advice}"
    _log.warning(line, path, share, name)
    return None if is_textured else colors
