"""Directions around an axis."""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

TWO_PI = wp.constant(wp.float32(2.0 * math.pi))


@wp.func
def around(axis: wp.vec3, cosine: float, sine: float, turn: float) -> wp.vec3:
    """The unit direction off a unit axis by the angle of that cosine and sine, ``turn`` (0..1) of the way round it.

    The two directions square to the axis are those of Duff et al. 2017, Building an Orthonormal Basis, Revisited.
    """
    sign = 1.0
    if axis[2] < 0.0:
        sign = -1.0
    a = -1.0 / (sign + axis[2])
    b = axis[0] * axis[1] * a
    first = wp.vec3(1.0 + sign * axis[0] * axis[0] * a, sign * b, -sign * axis[0])
    second = wp.vec3(b, sign + axis[1] * axis[1] * a, -axis[1])
    angle = TWO_PI * turn
    return wp.normalize(cosine * axis + sine * (wp.cos(angle) * first + wp.sin(angle) * second))
