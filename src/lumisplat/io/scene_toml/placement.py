"""Placement of an entry of a scene file: points of its file are scaled, then rotated, then translated.

A mesh or an actor whose entry says nothing of that is put into the captures of the scene: `inserted`.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import FLAG, NUMBER, QUATERNION, TEXT, VECTOR, TomlTable
from lumisplat.math.transforms import rotation_matrix
from lumisplat.scene.ops.insertion import insertion
from lumisplat.scene.placing import Placing, placed
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import Vector

_log = logging.getLogger("lumisplat")

PLACEMENT = {"position": VECTOR, "rotation_wxyz": QUATERNION, "scale": NUMBER}
"""Keys of the placement of an entry."""
STANDING = {"rotation_degrees": VECTOR, "look_at": VECTOR, "front": TEXT, "upright": FLAG}
"""Further keys of captures, meshes and actors: rotations in other words than a quaternion."""


_ROUNDING = 1e-15
"""Of the length of a direction that was normalised."""
_TURNS = ("rotation_wxyz", "rotation_degrees", "look_at", "upright")


_LEANS = 0.7
"""Height of y along up below which what has y up does not stand."""


def _is_saved(document: TomlTable) -> bool:
    """Whether a program has saved a scene file: up is a direction of length 1, to the last digit."""
    up: Any = document.values.get("up")
    is_written = VECTOR.accepts(up) and all(isinstance(value, float) for value in up)
    return is_written and abs(float(np.linalg.norm(up)) - 1.0) <= _ROUNDING


def is_placed(values: Mapping[str, Any]) -> bool:
    """Whether an entry says where it is or how it is turned: then it stands as it says, and nothing is assumed."""
    return any(key in values for key in ("position", *_TURNS)) or values.get("ground", False) is not False


def keep_saved_places(document: TomlTable) -> None:
    """Keeps meshes and actors of a scene file that a program saved where they were: at the origin, it wrote no place.

    Programs write up as a direction of length 1, to the last digit. Those of today write all places.
    """
    if not _is_saved(document):
        return
    for heading in ("meshes", "actors"):
        for table in document.tables(heading):
            if "path" in table.values and not is_placed(table.values):
                table.values["upright"] = False
                _say(
                    table,
                    "has no place, and up is as in saved files: it is as in its file; upright = true stands it up",
                )


def say_unturned(document: TomlTable, up: Vector) -> None:
    """Says of meshes and actors of files that they lie as in their files, where y is not up, though they have a place.

    Files that a program saved mean it, and so does who writes ``upright = false``.
    """
    if not document.tables("splats") or up[1] > _LEANS or _is_saved(document):
        return
    for heading in ("meshes", "actors"):
        for table in document.tables(heading):
            keys = table.values.keys()
            if (
                "path" in keys
                and is_placed(table.values)
                and keys.isdisjoint((*_TURNS, "front", "hidden", "keyframes"))
            ):
                _say(
                    table,
                    "says a place and no rotation, and has y up as in its file, though y is not up in the scene: "
                    "upright = true stands it up (upright = false keeps it, without this line)",
                )


def inserted(
    table: TomlTable, scene: Scene, things: Sequence[MeshInstance | SplatInstance], things_up: Vector | None
) -> npt.NDArray[np.float64]:
    """Puts what an entry without a place shows into the captures of a scene, and says so: ``world_from_file``.

    Args:
        table: The entry; ``scale``, ``front`` and ``ground = false`` are obeyed.
        scene: What is there already, with a capture at least.
        things: What the entry shows, where its file has it.
        things_up: Up in that file; None: y.

    Raises:
        FormatError: The scale is not positive.
    """
    try:
        found = insertion(scene, things, things_up, *(table.values.get(key) for key in ("scale", "front")))
    except SceneError as error:
        raise table.failed(error) from None
    matrix = found.world_from_thing
    if "ground" in table.values:
        matrix[:3, 3] = 0.0
        _say(table, "says no place, and stands upright where its file has it (upright = false: as in its file)")
    else:
        _say(table, f"says no place, and stands upright {found.where} (upright = false: as in its file): {found}")
    return matrix


def turned_upright(table: TomlTable, up: Vector) -> npt.NDArray[np.float64]:
    """Stands an actor upright that keyframes move, but do not turn, and says so: ``world_from_file``.

    Raises:
        FormatError: The scale is not positive.
    """
    matrix = placement(TomlTable.of(table.path, {**table.values, "upright": True}), up)
    _say(table, "says no rotation, and stands upright (upright = false: as in its file)")
    return matrix


def _say(table: TomlTable, line: str) -> None:
    asset = table.values.get("path")
    named = table.is_of_file or asset is None
    _log.warning("%s", table.error(line) if named else f"{Path(str(asset)).name}: {line}")


def placement(table: TomlTable, up: Vector = (0.0, 1.0, 0.0)) -> npt.NDArray[np.float64]:
    """``world_from_file`` of an entry, shape (4, 4).

    Args:
        table: An entry whose values have the right kinds.
        up: Unit vector that points up in the scene, for ``upright`` and ``look_at``.

    Raises:
        FormatError: A value is not finite, the scale is not positive, the rotation has zero length, or it is given
            twice.
    """
    words = [key for key in STANDING if key in table.values]
    if words:
        if "rotation_wxyz" in table.values:
            raise table.error(f"rotation_wxyz and {words[0]} are both given: choose one of them", words[0])
        given = {key: table.values.get(key) for key in ("position", "rotation_degrees", "scale", "look_at", "front")}
        stands = table.values.get("upright", "front" in table.values) or "look_at" in table.values
        try:
            return placed(None, Placing(**given, up=up if stands else None))
        except SceneError as error:
            raise table.failed(error) from None
    scale = table.values.get("scale", 1.0)
    position = table.values.get("position", (0.0, 0.0, 0.0))
    if not 0.0 < scale < np.inf:
        raise table.wrong("scale", "one positive number")
    if not np.isfinite(position).all():
        raise table.wrong("position", "three finite numbers")
    matrix = np.eye(4)
    try:
        matrix[:3, :3] = scale * rotation_matrix(table.values.get("rotation_wxyz", (1.0, 0.0, 0.0, 0.0)))
    except SceneError as error:
        raise table.error(f"rotation_wxyz is {error}", "rotation_wxyz") from None
    matrix[:3, 3] = position
    return matrix
