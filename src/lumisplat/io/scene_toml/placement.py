"""Placement of an entry of a scene file: points of its file are scaled, then rotated, then translated."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import NUMBER, QUATERNION, VECTOR, TomlTable
from lumisplat.math.rotations import rotation_matrix

PLACEMENT = {"position": VECTOR, "rotation_wxyz": QUATERNION, "scale": NUMBER}
"""Keys of the placement of an entry."""


def placement(table: TomlTable) -> npt.NDArray[np.float64]:
    """``world_from_file`` of an entry, shape (4, 4).

    Args:
        table: An entry whose values have the right kinds.

    Raises:
        FormatError: A value is not finite, the scale is not positive, or the rotation has zero length.
    """
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
