"""Angles of directions, and directions around an axis."""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

HALF_PI = wp.constant(wp.float32(0.5 * math.pi))
PI = wp.constant(wp.float32(math.pi))
TWO_PI = wp.constant(wp.float32(2.0 * math.pi))
INV_PI = wp.constant(wp.float32(1.0 / math.pi))
INV_TWO_PI = wp.constant(wp.float32(0.5 / math.pi))


@wp.func
def angle_of(y: float, x: float) -> float:
    """``atan2`` to 3e-7 radians, 0 at the origin: a quotient and a polynomial, faster than the library's.

    The polynomial is a minimax one of atan(t) / t on 0..1, in t^2.
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
def seen_from(to_eye: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """A unit direction to the eye, mirrored at the surface of a unit normal where it is below it.

    Silhouettes show Gaussians from a little beyond the horizon: they stand for what lies as far before it
    (docs/method/gaussians.md#normals).
    """
    return to_eye - 2.0 * wp.min(wp.dot(to_eye, normal), 0.0) * normal


@wp.func
def around(axis: wp.vec3, cosine: float, sine: float, turn: float) -> wp.vec3:
    """The unit direction at the angle of this cosine and sine from a unit axis, ``turn`` (0..1) of the way around it.

    The two tangents of the axis are those of Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    """
    sign = float(1.0)
    if axis[2] < 0.0:
        sign = -1.0
    a = -1.0 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    first = wp.vec3(1.0 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0])
    second = wp.vec3(b, sign + axis[1] * axis[1] * a, -axis[1])
    angle = TWO_PI * turn
    return wp.normalize(cosine * axis + sine * (wp.cos(angle) * first + wp.sin(angle) * second))
