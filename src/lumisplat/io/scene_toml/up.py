"""Which way is up in a scene file: ``up = "z-up"`` at its top, else what its captures suggest."""

from __future__ import annotations

from pathlib import Path

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import Kind, TomlTable, is_list
from lumisplat.scene.up import Vector, up_vector


def _may_be_direction(value: object) -> bool:
    return is_list(value) or isinstance(value, str)


DIRECTION = Kind("the name of an axis, such as y-down, or three numbers", _may_be_direction)
"""An axis by its name, or a direction."""

_CAPTURES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".json", "")
"""Ends of the paths of captures, .json of unpacked SOGs; those of folders of frames have none."""


def scene_up(document: TomlTable) -> Vector:
    """The unit vector that points up: as the file says, else y down with a capture, y up for meshes alone.

    Args:
        document: Top table of the scene file.

    Raises:
        FormatError: ``up`` is no direction.
    """
    if "up" in document.values:
        return direction(document, "up")
    actors = (Path(str(table.values.get("path"))).suffix.lower() for table in document.tables("actors"))
    has_capture = bool(document.tables("splats")) or any(suffix in _CAPTURES for suffix in actors)
    return up_vector("y-down" if has_capture else "y-up")


def direction(table: TomlTable, key: str) -> Vector:
    """The unit vector of a key.

    Raises:
        FormatError: It is no direction.
    """
    try:
        return up_vector(table.values[key])
    except SceneError as error:
        raise table.error(str(error), key) from None
