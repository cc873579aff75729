"""Converts words to transforms: up and front of scenes, which files do not state, positions and angles."""

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


FRONT_AXES = {"+z": 0.0, "-z": 180.0, "+x": -90.0, "-x": 90.0}
"""Axes that may be the front of an object with y up: the turn about y that takes each to +z, degrees."""


class Placing(NamedTuple):
    """How an instance is placed, in words instead of by a matrix."""

    position: npt.ArrayLike | None = None
    """World position of the object's origin, shape (3,); None: the world's origin."""
    rotation_degrees: npt.ArrayLike | None = None
    """Turns about the object's x, then y, then z axis, degrees, shape (3,)."""
    scale: float | None = None
    """Uniform scale factor, above 0."""
    up: str | npt.ArrayLike | None = None
    """Up of the scene: an object that was made with y up stands upright in it; None: as it is."""
    look_at: npt.ArrayLike | None = None
    """World position towards which the object's front is turned; ``up`` stays up."""
    front: str | None = None
    """Which of the object's axes is its front, a key of `FRONT_AXES`; None: +z, as in glTF."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlacedInstance:
    """What placed assets have in common; subclasses declare ``world_from_object`` and call `_place`."""

    name: str = ""
    position: InitVar[npt.ArrayLike | None] = None
    """In place of ``world_from_object``: world position of its origin, shape (3,)."""
    rotation_degrees: InitVar[npt.ArrayLike | None] = None
    """In place of ``world_from_object``: turns about its x, then y, then z axis, degrees, shape (3,)."""
    scale_by: InitVar[float | None] = None
    """In place of ``world_from_object``: uniform scale factor."""
    up: InitVar[str | npt.ArrayLike | None] = None
    """In place of ``world_from_object``: up of the scene, an axis (``"y-down"``) or a direction; what was made with y
    up, such as glTF, then stands upright."""
    look_at: InitVar[npt.ArrayLike | None] = None
    """In place of ``world_from_object``: world position to which its front is turned, with ``up`` up."""
    front: InitVar[str | None] = None
    """With ``up`` or ``look_at``: which of its axes is its front, ``"+z"`` (as in glTF, and the default), ``"-z"``,
    ``"+x"`` or ``"-x"``."""

    @property
    def transform(self) -> Doubles:
        """``world_from_object``, never None."""
        # A field of the subclasses, which takes its place behind what they place.
        matrix: Doubles | None = getattr(self, "world_from_object")  # noqa: B009
        assert matrix is not None
        return matrix

    def _place(
        self, world_from_object: npt.ArrayLike | None, placing: Placing, origin: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        """Makes ``world_from_object`` the checked matrix, the given one or that of the placing, else at ``origin``.

        Raises:
            SceneError: As of `placed`.
        """
        object.__setattr__(self, "world_from_object", placed(world_from_object, placing, origin))

    def _placement(self) -> str:
        """Name and position, and the scale unless that is 1."""
        matrix = self.transform
        scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
        scaled = f", scale={scale:.4g}" if abs(scale - 1.0) > SIMILARITY_TOLERANCE else ""
        return f"name={self.name!r}, position=({', '.join(f'{value:z.4g}' for value in matrix[:3, 3])}){scaled}"


def placed(world_from_object: npt.ArrayLike | None, placing: Placing, origin: Vector = (0.0, 0.0, 0.0)) -> Doubles:
    """``world_from_object``, shape (4, 4): points are scaled, turned, stood upright, then moved, else to ``origin``.

    Raises:
        SceneError: Both a matrix and a placing are given, or a value is out of range.
    """
    given = [name for name, value in placing._asdict().items() if value is not None]
    if not given and world_from_object is None:
        world_from_object = np.eye(4)
        world_from_object[:3, 3] = origin
    if not given:
        return matrix_4x4("world_from_object", world_from_object)
    if world_from_object is not None:
        raise SceneError(f"world_from_object and {given[0]} are both given: choose the matrix or the words")
    matrix = np.eye(4)
    matrix[:3, 3] = _vector("position", origin if placing.position is None else placing.position, 0.0)
    scale = 1.0 if placing.scale is None else placing.scale
    if not is_number(scale) or not 0.0 < scale < np.inf:
        raise SceneError(f"scale is {scale}, expected a positive number")
    x, y, z = np.radians(_vector("rotation_degrees", placing.rotation_degrees, 0.0))
    turn = axis_rotation((0, 0, 1), z) @ axis_rotation((0, 1, 0), y) @ axis_rotation((1, 0, 0), x)
    if placing.front is not None and placing.up is None and placing.look_at is None:
        raise SceneError("front is of objects that stand or look somewhere: give up or look_at, too")
    matrix[:3, :3] = scale * (_standing(placing, matrix[:3, 3]) @ turn)
    return matrix_4x4("world_from_object", matrix)


def front_turn(front: str | None) -> Doubles:
    """Returns the rotation about y that turns the front of an object with y up to +z, shape (3, 3).

    Args:
        front: A key of `FRONT_AXES`; None: +z.

    Raises:
        SceneError: It is no such axis.
    """
    if front is not None and front not in FRONT_AXES:
        raise SceneError(f"front is {front!r}, expected one of {', '.join(FRONT_AXES)}")
    return axis_rotation((0, 1, 0), math.radians(FRONT_AXES[front or "+z"])).round()


def _standing(placing: Placing, position: Doubles) -> Doubles:
    """Returns the rotation that stands an object with y up upright, and turns its front to what it looks at.

    Raises:
        SceneError: The front is no axis, or is turned to a point that is at no side.
    """
    to_z = front_turn(placing.front)
    up = np.array(up_vector("y-up" if placing.up is None else placing.up))
    front = front_vector(up)
    if placing.look_at is not None:
        front = _vector("look_at", placing.look_at, 0.0) - position
        distance = np.linalg.norm(front)
        right = np.cross(up, front)
        if np.linalg.norm(right) <= 1e-9 * max(float(distance), 1e-300):
            raise SceneError("look_at is at the position, or straight above or below it: it must be to a side")
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
