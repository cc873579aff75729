"""Transforms of objects from position, angles and front axis; up and front directions of scenes that state none."""

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
"""Unit up vectors by name: ``"y-down"`` means that y points down, so that up is (0, -1, 0)."""

_FRONTS: dict[str, Vector] = {
    "y-down": (0.0, 0.0, -1.0),
    "y-up": (0.0, 0.0, 1.0),
    "z-up": (0.0, -1.0, 0.0),
    "z-down": (0.0, -1.0, 0.0),
    "x-up": (0.0, 0.0, 1.0),
    "x-down": (0.0, 0.0, 1.0),
}
"""Unit direction from a scene to a viewer in front of the scene, by the name of the up axis. Captures (y-down) are
viewed along +z, glTF files (y-up) along -z."""


def up_vector_or_none(up: str | npt.ArrayLike | None, name: str = "up") -> Vector | None:
    """Returns the unit up vector for an axis name such as ``"y-down"``, or for a direction; None stays None."""
    return None if up is None else up_vector(up)


def up_vector(up: str | npt.ArrayLike) -> Vector:
    """Returns the unit up vector for an axis name such as ``"y-down"``, or for a direction of any length, (3,).

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
    """Returns the rotation, (3, 3), from a scene's axes to those of glTF: y up, z towards a viewer before the scene.

    For scenes with y down the rotation is 180 degrees about x.

    Args:
        up: Unit vector that points up in the scene, shape (3,).
    """
    upward, front = np.asarray(up, dtype=np.float64), front_vector(up)
    return np.stack([np.cross(upward, front), upward, front])


def front_vector(up: npt.ArrayLike) -> Doubles:
    """Returns the horizontal unit vector from a scene towards a viewer in front of it, by convention, shape (3,).

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
"""Rotation about y, degrees, that turns a front axis of an object with y up to +z, by the name of the front axis."""


class Placement(NamedTuple):
    """Arguments that place an instance without a matrix: position, angles, scale, up, target and front axis."""

    position: npt.ArrayLike | None = None
    """World position of the object's origin, shape (3,); None: the origin that the capture or mesh stores."""
    rotation_degrees: npt.ArrayLike | None = None
    """Rotations about the x, then y, then z axis in degrees, shape (3,), before the object is stood upright; None:
    none."""
    scale: float | None = None
    """Uniform scale factor, above 0; None: 1."""
    up: str | npt.ArrayLike | None = None
    """Up direction of the scene: the y axis of the object, which is up in its file, is rotated to this direction.
    None: no such rotation."""
    look_at: npt.ArrayLike | None = None
    """World position towards which the object's front axis is turned; None: the front of the scene (`front_vector`)."""
    front: str | None = None
    """Axis that is the object's front before any rotation, a key of `FRONT_AXES`; None: +z, as in glTF."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlacedInstance:
    """Base class of `SplatInstance` and `MeshInstance`. These declare ``world_from_object``, and set it by `_place`."""

    name: str = ""
    position: InitVar[npt.ArrayLike | None] = None
    """World position of the object's origin, shape (3,); None: the origin that the capture or mesh stores. The
    placement arguments (position, angles, scale, up, target, front) exclude ``world_from_object``."""
    rotation_degrees: InitVar[npt.ArrayLike | None] = None
    """Right-handed rotations about the x, then y, then z axis in degrees, shape (3,), before the object is stood
    upright; None: none."""
    scale_by: InitVar[float | None] = None
    """Uniform scale factor, above 0; None: 1."""
    up: InitVar[str | npt.ArrayLike | None] = None
    """Up direction of the scene, by name (``"y-down"``) or as a vector: the y axis of the object, up in glTF files, is
    rotated to this direction. None: no such rotation."""
    look_at: InitVar[npt.ArrayLike | None] = None
    """World position towards which the object's front is turned. None: the front is turned to the front of the scene.
    """
    front: InitVar[str | None] = None
    """Axis of the object that is turned to the front of the scene, or to ``look_at``: ``"+z"`` (the default, as in
    glTF), ``"-z"``, ``"+x"`` or ``"-x"``. Needs ``up`` or ``look_at``."""

    @property
    def transform(self) -> Doubles:
        """Object-to-world matrix, (4, 4): the field ``world_from_object``, which is not None after construction."""
        # The subclasses declare this field after the asset.
        matrix: Doubles | None = getattr(self, "world_from_object")  # noqa: B009
        assert matrix is not None
        return matrix

    def _place(
        self, world_from_object: npt.ArrayLike | None, placing: Placement, origin: Vector = (0.0, 0.0, 0.0)
    ) -> None:
        """Sets the field ``world_from_object`` to the result of `placed` for the same arguments.

        Raises:
            SceneError: As in `placed`.
        """
        object.__setattr__(self, "world_from_object", placed(world_from_object, placing, origin))

    def _placement(self) -> str:
        """Returns text for ``repr``: the instance's name and position, and the scale if it is not 1."""
        matrix = self.transform
        scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
        scaled = f", scale={scale:.4g}" if abs(scale - 1.0) > SIMILARITY_TOLERANCE else ""
        return f"name={self.name!r}, position=({', '.join(f'{value:z.4g}' for value in matrix[:3, 3])}){scaled}"


def placed(world_from_object: npt.ArrayLike | None, placing: Placement, origin: Vector = (0.0, 0.0, 0.0)) -> Doubles:
    """Returns the given matrix, or else one that scales, rotates, stands upright and then moves an object, (4, 4).

    Without a position in ``placing``, the object moves to ``origin``.

    Raises:
        SceneError: Both a matrix and a field of ``placing`` are given, or a value is out of range.
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
    """Returns the rotation, (3, 3), that turns y of an object to the scene's up, and its front to ``look_at``.

    Without ``look_at`` the front turns to `front_vector`. ``position`` is the object's world position.

    Raises:
        SceneError: The front is no axis, or ``look_at`` lies straight above or below ``position``.
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
