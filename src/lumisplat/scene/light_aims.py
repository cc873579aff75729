"""Where lights shine: their directions, or what they are aimed at."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import finite_numbers, float_array, host_array, unit_vector
from lumisplat.scene.checks import Vector


def vector(name: str, values: npt.ArrayLike) -> Vector:
    """Three finite numbers.

    Raises:
        SceneError: They are something else.
    """
    array = float_array(name, values)
    if array.shape != (3,):
        raise SceneError(f"{name} has shape {array.shape}, expected three numbers")
    x, y, z = (float(v) for v in np.asarray(host_array(values), dtype=np.float64))
    return x, y, z


def to_vector(values: npt.ArrayLike, name: str = "vector") -> Vector:
    """Converts a field to three finite numbers, see `vector`."""
    return vector(name, values)


def direction_of(name: str, values: npt.ArrayLike) -> Vector:
    """A unit vector.

    Raises:
        SceneError: The values have no length, or are not three finite numbers.
    """
    given = np.array(vector(name, values))
    if np.linalg.norm(given) == 0.0:
        raise SceneError(f"{name} has no length")
    x, y, z = (float(v) for v in unit_vector(given))
    return x, y, z


def towards(kind: str, direction: npt.ArrayLike, start: Vector, target: npt.ArrayLike | None) -> Vector:
    """The unit direction that is given, or that from a start to a target.

    Raises:
        SceneError: Both are given, or neither, or the target is at the start.
    """
    is_given = bool(np.any(np.asarray(vector("direction", direction)) != 0.0))
    if target is None:
        if not is_given:
            raise SceneError(f"direction has no length: {kind} needs one, or a target")
        return direction_of("direction", direction)
    if is_given:
        raise SceneError(f"direction and target of {kind} are both given: choose one of them")
    along = np.subtract(vector("target", target), start)
    if not along.any():
        raise SceneError(f"target of {kind} is where it stands: they must be apart")
    return direction_of("direction", along)


def facing_edges(
    position: Vector, edges: tuple[Vector, Vector], target: npt.ArrayLike | None, size: npt.ArrayLike | None
) -> tuple[Vector, Vector]:
    """Edges of a rectangle that faces a target: ``edge_u`` level with y along the vertical.

    Raises:
        SceneError: Only one of both is given, edges are given too, or the size is not positive.
    """
    if target is None or size is None:
        raise SceneError("target and size of a rect go together: where it faces, and how large it is")
    if np.any(edges):
        raise SceneError("edge_u and target of a rect are both given: choose the edges, or the target and the size")
    sizes = finite_numbers(size, (2,))
    if sizes is None or not (sizes > 0.0).all():
        raise SceneError(f"size is {size}, expected two positive numbers, width and height")
    forward = np.array(towards("a rect", (0.0, 0.0, 0.0), position, target))
    # Level with y; straight up or down, with z.
    across = np.cross((0.0, 1.0, 0.0) if abs(forward[1]) < 0.999999 else (0.0, 0.0, 1.0), forward)
    across /= np.linalg.norm(across)
    return vector("edge_u", sizes[0] * across), vector("edge_v", sizes[1] * np.cross(forward, across))
