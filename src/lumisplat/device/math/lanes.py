"""Loops over lanes that compilers turn into vector instructions: arrays of lanes, and vectors without branches.

Such a loop has a constant number of turns, reads and writes only arrays of lanes, and calls functions without branches
(docs/adr/0114-rays-in-lanes-without-vec3.md).
"""

from typing import Any

import warp as wp

# --- Arrays of lanes in a local variable of a kernel ---

_ROWS = {1: 1, 2: 3, 3: 9}
"""Rows of an array of lanes by its number of dimensions: a number, a vector or a matrix in each lane."""

_SHAPES = {1: "{lanes}", 2: "3, {lanes}", 3: "3, 3, {lanes}"}


def lanes_of(struct_type: Any, count: int) -> tuple[Any, Any]:
    """Builds memory for a struct of arrays of lanes, and a function that points the arrays to it.

    Args:
        struct_type: Struct whose fields have types ``wp.array`` (an element in each lane), ``wp.array2d`` (three rows:
            a vector in each lane) or ``wp.array3d`` (a matrix in each lane), with elements of four bytes.
        count: Number of lanes.

    Returns:
        The type of a kernel's local variable, and ``point_lanes(memory, lanes)``, which sets the fields of ``lanes``.
    """
    lines: list[str] = []
    rows = 0
    for name, variable in struct_type.vars.items():
        start = f"reinterpret_cast<wp::uint64>(&memory) + {4 * count * rows}"
        shape = _SHAPES[variable.type.ndim].format(lanes=count)
        lines.append(f"lanes.{name} = decltype(lanes.{name})({start}, {shape});")
        rows += _ROWS[variable.type.ndim]
    memory_type = wp.types.vector(length=rows * count, dtype=wp.float32)

    @wp.func_native("\n".join(lines))
    def point_lanes(memory: wp.ref[memory_type], lanes: wp.ref[struct_type]): ...

    return memory_type, point_lanes


@wp.func
def vector_in(rows: wp.array2d[float], lane: int) -> wp.vec3:
    """Returns the vector in a lane."""
    return wp.vec3(rows[0, lane], rows[1, lane], rows[2, lane])


@wp.func
def store_vector(rows: wp.array2d[float], lane: int, vector: wp.vec3):
    """Writes the vector in a lane."""
    rows[0, lane] = vector[0]
    rows[1, lane] = vector[1]
    rows[2, lane] = vector[2]


@wp.func
def matrix_in(rows: wp.array3d[float], lane: int) -> wp.mat33:
    """Returns the matrix in a lane."""
    return wp.mat33(
        rows[0, 0, lane],
        rows[0, 1, lane],
        rows[0, 2, lane],
        rows[1, 0, lane],
        rows[1, 1, lane],
        rows[1, 2, lane],
        rows[2, 0, lane],
        rows[2, 1, lane],
        rows[2, 2, lane],
    )


@wp.func
def store_matrix(rows: wp.array3d[float], lane: int, matrix: wp.mat33):
    """Writes the matrix in a lane."""
    for k in range(3):
        for l in range(3):
            rows[k, l, lane] = matrix[k, l]


# --- Vectors without branches ---


@wp.func
def picked(condition: bool, vector: wp.vec3, otherwise: wp.vec3) -> wp.vec3:
    """Returns ``vector`` if the condition holds, else ``otherwise``."""
    x = otherwise[0]
    y = otherwise[1]
    z = otherwise[2]
    if condition:  # three numbers, between which compilers select; between vectors, they would branch
        x = vector[0]
        y = vector[1]
        z = vector[2]
    return wp.vec3(x, y, z)


@wp.func
def unit_of(vector: wp.vec3) -> wp.vec3:
    """Returns ``wp.normalize(vector)``: the unit vector, or zero for a vector of length 0."""
    length = wp.length(vector)
    return picked(length > 0.0, vector / length, wp.vec3(0.0))
