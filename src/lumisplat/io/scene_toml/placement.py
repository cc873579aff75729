"""Placement of an entry of a scene file: points of its file are scaled, then rotated, then translated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import FLAG, NUMBER, QUATERNION, TEXT, VECTOR, TomlTable
from lumisplat.math.rotations import rotation_matrix
from lumisplat.scene.placing import Placing, placed
from lumisplat.scene.up import Vector

PLACEMENT = {"position": VECTOR, "rotation_wxyz": QUATERNION, "scale": NUMBER}
"""Keys of the placement of an entry."""
STANDING = {"rotation_degrees": VECTOR, "look_at": VECTOR, "front": TEXT, "upright": FLAG}
"""Further keys of captures, meshes and actors: rotations in other words than a quaternion."""


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
        stands = table.values.get("upright", False) or "look_at" in table.values
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
