"""Where an entry of a scene file stands: a point of its file is scaled, then rotated, then moved."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import NUMBER, QUATERNION, VECTOR, TomlTable
from lumisplat.math.rotations import rotation_matrix

PLACEMENT = {"position": VECTOR, "rotation_wxyz": QUATERNION, "scale": NUMBER}
"""Keys of an entry that is placed."""


def placement(table: TomlTable) -> npt.NDArray[np.float64]:
    """``world_from_file`` of an entry, shape (4, 4).

    Args:
        table: An entry whose values are of their kinds.

    Raises:
        FormatError: A value is not finite, a scale not positive, or a rotation of zero length.
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
