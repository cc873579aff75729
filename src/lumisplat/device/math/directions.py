"""Directions: angles, directions around an axis, and the equal-area octahedral map between sphere and unit square."""

import math

import warp as wp

from lumisplat.device.math.lanes import unit_of

HALF_PI = wp.constant(wp.float32(0.5 * math.pi))

PI = wp.constant(wp.float32(math.pi))

TWO_PI = wp.constant(wp.float32(2.0 * math.pi))

INV_PI = wp.constant(wp.float32(1.0 / math.pi))

INV_TWO_PI = wp.constant(wp.float32(0.5 / math.pi))


@wp.func
def angle_of(y: float, x: float) -> float:
    """Returns ``atan2(y, x)`` to 3e-7 radians, 0 at the origin; faster than the library function.

    It evaluates a minimax polynomial in t^2 of atan(t) / t on 0..1.
    """
    across = wp.abs(y)
    along = wp.abs(x)
    t = wp.min(across, along) / wp.max(wp.max(across, along), 1e-30)
    t2 = t * t
    p = 0.099142909 + t2 * (-0.0594863668 + t2 * (0.0242523849 - t2 * 0.00469327066))
    angle = t * (0.999999881 + t2 * (-0.333319902 + t2 * (0.199697241 + t2 * (-0.140194803 + t2 * p))))
    if across > along:
        angle = HALF_PI - angle
    if x < 0.0:
        angle = PI - angle
    if y < 0.0:
        angle = -angle
    return angle


@wp.func
def flipped_to_front(to_eye: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Returns ``to_eye``; if it points behind the surface, mirrored at the plane orthogonal to ``normal``.

    At silhouettes, pixels show Gaussians whose unit ``normal`` points slightly away from the eye. They are shaded as if
    the normal pointed towards the eye by the same angle (docs/method/gaussians.md#normals).
    """
    return to_eye - 2.0 * wp.min(wp.dot(to_eye, normal), 0.0) * normal


@wp.func
def around(axis: wp.vec3, cosine: float, sine: float, turn: float) -> wp.vec3:
    """Returns the unit direction at a polar angle from ``axis`` and at azimuth ``turn``, 0..1 for a full circle.

    The polar angle is given by its cosine and sine. The tangents of the axis follow Duff et al. 2017, Building an
    Orthonormal Basis, Revisited.
    """
    angle = TWO_PI * turn
    return direction_around(axis, cosine, sine, wp.cos(angle), wp.sin(angle))


@wp.func
def direction_around(axis: wp.vec3, cosine: float, sine: float, cos_turn: float, sin_turn: float) -> wp.vec3:
    """Returns ``around`` from the cosine and sine of the azimuth."""
    sign = float(1.0)
    if axis[2] < 0.0:
        sign = -1.0
    a = -1.0 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    first = wp.vec3(1.0 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0])
    second = wp.vec3(b, sign + axis[1] * axis[1] * a, -axis[1])
    return unit_of(cosine * axis + sine * (cos_turn * first + sin_turn * second))


# --- The octahedral map: a square in which equal areas are equal solid angles (Clarberg 2008) ---
#
# The upper half of the sphere is the diamond in the middle, the lower half the four corners folded outwards. The
# equations are in docs/method/realtime.md#screen-probes.

QUARTER_PI = wp.constant(wp.float32(0.25 * math.pi))

TWO_OVER_PI = wp.constant(wp.float32(2.0 / math.pi))


@wp.func
def signed_as(size: float, sign: float) -> float:
    """Returns the magnitude ``size`` with the sign of ``sign``."""
    return wp.where(sign < 0.0, -size, size)


@wp.func
def direction_of_square(point: wp.vec2) -> wp.vec3:
    """Maps a point of the unit square to a unit direction by the equal-area octahedral map."""
    u = 2.0 * point[0] - 1.0
    v = 2.0 * point[1] - 1.0
    inside = 1.0 - (wp.abs(u) + wp.abs(v))  # positive: in the diamond
    r = 1.0 - wp.abs(inside)
    angle = QUARTER_PI
    if r > 0.0:
        angle *= (wp.abs(v) - wp.abs(u)) / r + 1.0
    across = r * wp.sqrt(2.0 - r * r)
    x = signed_as(across * wp.cos(angle), u)
    y = signed_as(across * wp.sin(angle), v)
    return wp.vec3(x, y, signed_as(1.0 - r * r, inside))


@wp.func
def square_of_direction(direction: wp.vec3) -> wp.vec2:
    """Maps a unit direction to a point of the unit square by the equal-area octahedral map."""
    x = wp.abs(direction[0])
    y = wp.abs(direction[1])
    r = wp.sqrt((x * x + y * y) / (1.0 + wp.abs(direction[2])))
    longer = wp.max(x, y)
    share = float(0.0)
    if longer > 0.0:
        share = TWO_OVER_PI * wp.atan(wp.min(x, y) / longer)
    if x < y:
        share = 1.0 - share
    v = share * r
    u = r - v
    if direction[2] < 0.0:
        swapped = u
        u = 1.0 - v
        v = 1.0 - swapped
    return wp.vec2(0.5 + 0.5 * signed_as(u, direction[0]), 0.5 + 0.5 * signed_as(v, direction[1]))


@wp.func
def cell_of_direction(direction: wp.vec3, cells: int) -> int:
    """Returns the index, in row order, of the cell of an octahedral map that contains a unit direction.

    The map has ``cells`` x ``cells`` cells.
    """
    point = square_of_direction(direction)
    x = wp.clamp(int(point[0] * float(cells)), 0, cells - 1)
    y = wp.clamp(int(point[1] * float(cells)), 0, cells - 1)
    return y * cells + x


@wp.func
def direction_in_cell(cell: int, cells: int, within: wp.vec2) -> wp.vec3:
    """Returns a unit direction within cell ``cell`` of an octahedral map of ``cells`` x ``cells`` cells.

    ``within`` is its position in the cell, 0..1 along each side; the cell's centre is (0.5, 0.5).
    """
    y = cell // cells
    x = cell - y * cells
    size = 1.0 / float(cells)
    return wp.normalize(direction_of_square(wp.vec2((float(x) + within[0]) * size, (float(y) + within[1]) * size)))


@wp.func
def cell_width(cells: int) -> float:
    """Returns ``sqrt(4 pi) / cells``, the angular width in radians of a cell of an octahedral map."""
    return 2.0 * wp.sqrt(PI) / float(cells)


@wp.func
def wrapped_cell(x: int, y: int, cells: int) -> int:
    """Returns the index of a cell of an octahedral map by column ``x`` and row ``y``, each from -1 to ``cells``.

    The border of the map is folded onto itself, so that a cell one beyond it is another cell of the map.
    """
    if x < 0 or x >= cells:
        x = wp.clamp(x, 0, cells - 1)
        y = cells - 1 - y
    if y < 0 or y >= cells:
        y = wp.clamp(y, 0, cells - 1)
        x = cells - 1 - x
    return y * cells + x
