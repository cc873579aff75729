"""Which way is up in a scene file: ``up = "z-up"`` at its top, else what its captures state, else a guess."""

from __future__ import annotations

from pathlib import Path

from lumisplat.errors import FormatError, SceneError
from lumisplat.io.scene_toml.placement import PLACEMENT, STANDING, placement
from lumisplat.io.scene_toml.stated_up import stated_up
from lumisplat.io.scene_toml.toml_table import Kind, TomlTable, is_list
from lumisplat.scene.up import Vector, up_vector


def _may_be_direction(value: object) -> bool:
    return is_list(value) or isinstance(value, str)


DIRECTION = Kind("the name of an axis, such as y-down, or three numbers", _may_be_direction)
"""An axis by its name, or a direction."""

_CAPTURES = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".json", "")
"""Ends of the paths of captures, .json of unpacked SOGs; those of folders of frames have none."""


def scene_up(document: TomlTable) -> Vector:
    """Returns the unit vector that points up.

    It is what the file says, else what the first capture states of which the file does, else y down with a capture, y
    up for meshes alone.

    Args:
        document: Top table of the scene file.

    Raises:
        FormatError: ``up`` is no direction.
    """
    if "up" in document.values:
        return direction(document, "up")
    for table in document.tables("splats"):
        if (up := _stated(table)) is not None:
            return up
    actors = (Path(str(table.values.get("path"))).suffix.lower() for table in document.tables("actors"))
    has_capture = bool(document.tables("splats")) or any(suffix in _CAPTURES for suffix in actors)
    return up_vector("y-down" if has_capture else "y-up")


def _stated(table: TomlTable) -> Vector | None:
    """Returns up as the file of a capture states it, turned as the entry turns the capture; None: it states none.

    An entry that is stood upright follows the scene, and says nothing about it.
    """
    stands = table.values.get("upright", False) or "look_at" in table.values
    path = table.values.get("path")
    if stands or not isinstance(path, str) or (up := stated_up(table.path.parent / path)) is None:
        return None
    keys = {key: kind for key, kind in (PLACEMENT | STANDING).items() if key.startswith("rotation")}
    turned = {key: value for key, value in table.values.items() if key in keys and keys[key].accepts(value)}
    try:
        return up_vector(placement(TomlTable.of(table.path, turned))[:3, :3] @ up)
    except FormatError:  # said where the entry is read
        return None


def direction(table: TomlTable, key: str) -> Vector:
    """The unit vector of a key.

    Raises:
        FormatError: It is no direction.
    """
    try:
        return up_vector(table.values[key])
    except SceneError as error:
        raise table.error(str(error), key) from None
