"""Placement of objects by position, angles and front; up and front directions of scenes, which files may not store."""

from __future__ import annotations

import math
from dataclasses import InitVar, dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.constants import SIMILARITY_TOLERANCE
from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers, matrix_4x4, unit_vector
from lumisplat.math.transforms import axis_rotation
from lumisplat.scene.checks import Vector

UP_AXES: dict[str, Vector] = {
    "y-down": (0.0, -1.0, 0.0),
    "y-up": (0.0, 1.0, 0.0),
    "z-up": (0.0, 0.0, 1.0),
    "z-down": (0.0, 0.0, -1.0),
    "x-up": (1.0, 0.0, 0.0),
    "x-down": (-1.0, 0.0, 0.0),
}
"""Up directions by name."""

_FRONTS: dict[str, Vector] = {
    "y-down": (0.0, 0.0, -1.0),
    "y-up": (0.0, 0.0, 1.0),
    "z-up": (0.0, -1.0, 0.0),
    "z-down": (0.0, -1.0, 0.0),
    "x-up": (0.0, 0.0, 1.0),
    "x-down": (0.0, 0.0, 1.0),
}
"""Direction from a scene to a viewer in front of it, by up axis: captures are viewed along +z, glTF files along -z."""


def up_vector_or_none(up: str | npt.ArrayLike | None, name: str = "up") -> Vector | None:
    """Converts the name of an axis or a direction to a unit up vector; None stays None."""
    return None if up is None else up_vector(up)


def up_vector(up: str | npt.ArrayLike) -> Vector:
    """Returns a unit up vector from the name of an axis, or from a direction of any length, shape (3,).

    Raises:
        SceneError: The value is neither the name of an axis nor a direction.
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
    """Returns the rotation, shape (3, 3), that takes a scene to coordinates with y up and z to the front, as in glTF.

    For scenes with y down the rotation is 180 degrees about x.

    Args:
        up: Unit vector that points up in the scene, shape (3,).
    """
    upward, front = np.asarray(up, dtype=np.float64), front_vector(up)
    return np.stack([np.cross(upward, front), upward, front])


def front_vector(up: npt.ArrayLike) -> Doubles:
    """Returns the horizontal unit vector from a scene to a viewer in front of it, shape (3,).

    Args:
        up: Unit vector that points up, shape (3,). For an up vector between the axes, the front of the nearest axis is
            made horizontal.
    """
    upward = np.asarray(up, dtype=np.float64)
    nearest = max(UP_AXES, key=lambda name: float(upward @ np.array(UP_AXES[name])))
    front = np.array(_FRONTS[nearest])
    level = front - (front @ upward) * upward
    return level / np.linalg.norm(level)


FRONT_AXES = {"+z": 0.0, "-z": 180.0, "+x": -90.0, "-x": 90.0}
"""Front axes of objects with y up, and the rotation about y in degrees that turns each to +z."""


class Placement(NamedTuple):
    """Placement of an instance by position, angles, scale, up and target, instead of a matrix."""

    position: npt.ArrayLike | None = None
    """World position of the object's origin, shape (3,); None: the world's origin."""
    rotation_degrees: npt.ArrayLike | None = None
    """Rotations about the x, then y, then z axis in degrees, shape (3,)."""
    scale: float | None = None
    """Uniform scale factor, above 0."""
    up: str | npt.ArrayLike | None = None
    """Up direction of the scene; an object with y up is rotated upright there. None: no such rotation."""
    look_at: npt.ArrayLike | None = None
    """World position that the object's front faces, while the object stays upright."""
    front: str | None = None
    """Axis that is the object's front, a key of `FRONT_AXES`; None: +z, as in glTF."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlacedInstance:
    """Base class of placed assets; subclasses declare ``world_from_object`` and call `_place`."""

    name: str = ""
    position: InitVar[npt.ArrayLike | None] = None
    """World position of the object's origin, shape (3,). Position, angles, scale, up, target and front together
    replace ``world_from_object``."""
    rotation_degrees: InitVar[npt.ArrayLike | None] = None
    """Rotations about the x, then y, then z axis in degrees, shape (3,)."""
    scale_by: InitVar[float | None] = None
    """Uniform scale factor."""
    up: InitVar[str | npt.ArrayLike | None] = None
    """Up direction of the scene, an axis (``"y-down"``) or a direction; an object with y up, as in glTF, is rotated
    upright there."""
    look_at: InitVar[npt.ArrayLike | None] = None
    """World position that the object's front faces, while the object stays upright along ``up``."""
    front: InitVar[str | None] = None
    """Axis that is the object's front, with ``up`` or ``look_at``: ``"+z"`` (the default, as in glTF), ``"-z"``,
    ``"+x"`` or ``"-x"``."""

    @property
    def transform(self) -> Doubles:
        """Object-to-world transform, ``world_from_object``, never None."""
        # The subclasses declare this field after the asset.
        matrix: Doubles | None = getattr(self, "world_from_object")  # noqa: B009
        assert matrix is not None
        return matrix

    def _place(
        self, world_from_object: npt.ArrayLike | None, placing: Placement, origin: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        """Sets ``world_from_object`` to the given matrix, else that of ``placing``, else a translation to ``origin``.

        Raises:
            SceneError: As in `placed`.
        """
        object.__setattr__(self, "world_from_object", placed(world_from_object, placing, origin))

    def _placement(self) -> str:
        """Returns the instance's name, position, and scale unless it is 1, as text for ``repr``."""
        matrix = self.transform
        scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
        scaled = f", scale={scale:.4g}" if abs(scale - 1.0) > SIMILARITY_TOLERANCE else ""
        return f"name={self.name!r}, position=({', '.join(f'{value:z.4g}' for value in matrix[:3, 3])}){scaled}"


def placed(world_from_object: npt.ArrayLike | None, placing: Placement, origin: Vector = (0.0, 0.0, 0.0)) -> Doubles:
    """Returns the matrix of a placement, shape (4, 4): scale, rotate, stand upright, then move; or the given matrix.

    Without a position, the object moves to ``origin``.

    Raises:
        SceneError: Both a matrix and a placement are given, or a value is out of range.
    """
    given = [name for name, value in placing._asdict().items() if value is not None]
    if not given and world_from_object is None:
        world_from_object = np.eye(4)
        world_from_object[:3, 3] = origin
    if not given:
        return matrix_4x4("world_from_object", world_from_object)
    if world_from_object is not None:
        raise SceneError(f"world_from_object and {given[0]} are both given: give one of them")
    matrix = np.eye(4)
    matrix[:3, 3] = _vector("position", origin if placing.position is None else placing.position, 0.0)
    scale = 1.0 if placing.scale is None else placing.scale
    if not is_number(scale) or not 0.0 < scale < np.inf:
        raise SceneError(f"scale is {scale}, expected a positive number")
    x, y, z = np.radians(_vector("rotation_degrees", placing.rotation_degrees, 0.0))
    turn = axis_rotation((0, 0, 1), z) @ axis_rotation((0, 1, 0), y) @ axis_rotation((1, 0, 0), x)
    if placing.front is not None and placing.up is None and placing.look_at is None:
        raise SceneError("front needs up or look_at: give one of them, too")
    matrix[:3, :3] = scale * (_standing(placing, matrix[:3, 3]) @ turn)
    return matrix_4x4("world_from_object", matrix)


def front_rotation(front: str | None) -> Doubles:
    """Returns the rotation about y that turns the front of an object with y up to +z, shape (3, 3).

    Args:
        front: A key of `FRONT_AXES`; None: +z.

    Raises:
        SceneError: ``front`` is not a key of `FRONT_AXES`.
    """
    if front is not None and front not in FRONT_AXES:
        raise SceneError(f"front is {front!r}, expected one of {', '.join(FRONT_AXES)}")
    return axis_rotation((0, 1, 0), math.radians(FRONT_AXES[front or "+z"])).round()


def _standing(placing: Placement, position: Doubles) -> Doubles:
    """Returns the rotation that stands an object with y up upright in the scene, and turns its front to the target.

    Raises:
        SceneError: The front is no axis, or the target lies straight above or below.
    """
    to_z = front_rotation(placing.front)
    up = np.array(up_vector("y-up" if placing.up is None else placing.up))
    front = front_vector(up)
    if placing.look_at is not None:
        front = _vector("look_at", placing.look_at, 0.0) - position
        distance = np.linalg.norm(front)
        right = np.cross(up, front)
        if np.linalg.norm(right) <= 1e-9 * max(float(distance), 1e-300):
            raise SceneError("look_at is at the position, or straight above or below it: move it sideways")
        right /= np.linalg.norm(right)
        front = front / distance
        return np.stack([right, np.cross(front, right), front], axis=1) @ to_z
    return np.stack([np.cross(up, front), up, front], axis=1) @ to_z


def _vector(name: str, values: npt.ArrayLike | None, rest: float) -> Doubles:
    if values is None:
        return np.full(3, rest)
    vector = finite_numbers(values, (3,))
    if vector is None:
        raise SceneError(f"{name} is {values}, expected three finite numbers")
    return vector
