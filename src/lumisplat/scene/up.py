"""Which way is up in a scene, and from which side it is looked at: files do not say it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers, unit_vector
from lumisplat.scene.checks import Vector

UP_AXES: dict[str, Vector] = {
    "y-down": (0.0, -1.0, 0.0),
    "y-up": (0.0, 1.0, 0.0),
    "z-up": (0.0, 0.0, 1.0),
    "z-down": (0.0, 0.0, -1.0),
    "x-up": (1.0, 0.0, 0.0),
    "x-down": (-1.0, 0.0, 0.0),
}
"""Directions that point up, by name."""

_FRONTS: dict[str, Vector] = {
    "y-down": (0.0, 0.0, -1.0),
    "y-up": (0.0, 0.0, 1.0),
    "z-up": (0.0, -1.0, 0.0),
    "z-down": (0.0, -1.0, 0.0),
    "x-up": (0.0, 0.0, 1.0),
    "x-down": (0.0, 0.0, 1.0),
}
"""Where the eye stands that looks at the front: before captures seen along +z, and before glTF files seen along -z."""


def up_vector_or_none(up: str | npt.ArrayLike | None, name: str = "up") -> Vector | None:
    """Converts a field to a unit vector that points up; None stays."""
    return None if up is None else up_vector(up)


def up_vector(up: str | npt.ArrayLike) -> Vector:
    """A unit vector that points up, from the name of an axis or from a direction of any length, shape (3,).

    Raises:
        SceneError: It is neither.
    """
    if isinstance(up, str):
        if up not in UP_AXES:
            raise SceneError(f"up is {up!r}, expected {', '.join(UP_AXES)}, or a direction")
        return UP_AXES[up]
    direction = finite_numbers(up, (3,))
    length = 0.0 if direction is None else float(np.linalg.norm(direction))
    if direction is None or not 0.0 < length < np.inf:
        raise SceneError(f"up is {up}, expected {', '.join(UP_AXES)}, or a direction of three numbers, not all 0")
    x, y, z = (float(value) for value in unit_vector(direction))
    return x, y, z


def y_up_from(up: npt.ArrayLike) -> Doubles:
    """Returns the rotation after which y is up and the front is z, as in glTF: for y down, half a turn about x.

    Its shape is (3, 3).

    Args:
        up: Unit vector that points up, shape (3,).
    """
    upward, front = np.asarray(up, dtype=np.float64), front_vector(up)
    return np.stack([np.cross(upward, front), upward, front])


def front_vector(up: npt.ArrayLike) -> Doubles:
    """The horizontal unit vector towards the eye that sees a scene from the front, shape (3,).

    Args:
        up: Unit vector that points up, shape (3,). Between the axes, the front is that of the nearest one, levelled.
    """
    upward = np.asarray(up, dtype=np.float64)
    nearest = max(UP_AXES, key=lambda name: float(upward @ np.array(UP_AXES[name])))
    front = np.array(_FRONTS[nearest])
    level = front - (front @ upward) * upward
    return level / np.linalg.norm(level)
