"""Real spherical harmonics up to degree 3, with the basis order and signs of Kerbl et al. 2023.

The equations are in docs/method/gaussians.md#colour.
"""

import warp as wp

from lumisplat.constants import SH_C0

C0 = wp.constant(wp.float32(SH_C0))
C1 = wp.constant(wp.float32(0.4886025119029199))  # sqrt(3 / (4 pi))
C2_XY = wp.constant(wp.float32(1.0925484305920792))  # sqrt(15 / (4 pi))
C2_ZZ = wp.constant(wp.float32(0.31539156525252005))  # sqrt(5 / (16 pi))
C2_XX = wp.constant(wp.float32(0.5462742152960396))  # sqrt(15 / (16 pi))
C3_0 = wp.constant(wp.float32(0.5900435899266435))  # sqrt(35 / (32 pi))
C3_1 = wp.constant(wp.float32(2.890611442640554))  # sqrt(105 / (4 pi))
C3_2 = wp.constant(wp.float32(0.4570457994644658))  # sqrt(21 / (32 pi))
C3_3 = wp.constant(wp.float32(0.3731763325901154))  # sqrt(7 / (16 pi))
C3_5 = wp.constant(wp.float32(1.445305721320277))  # sqrt(105 / (16 pi))


@wp.func
def sh_color(sh: wp.array[wp.vec3], first: int, degree: int, direction: wp.vec3) -> wp.vec3:
    """Returns the SH colour of a Gaussian, ``max(sum + 0.5, 0)``, display-referred, along a unit view direction.

    ``sh[first]`` is its coefficient of degree 0; ``direction`` points from the eye to the mean, object space.
    """
    color = C0 * sh[first] + wp.vec3(0.5)
    if degree > 0:
        x = direction[0]
        y = direction[1]
        z = direction[2]
        color += C1 * (z * sh[first + 2] - y * sh[first + 1] - x * sh[first + 3])
        if degree > 1:
            xx = x * x
            yy = y * y
            zz = z * z
            color += (C2_XY * x * y) * sh[first + 4] - (C2_XY * y * z) * sh[first + 5]
            color += (C2_ZZ * (2.0 * zz - xx - yy)) * sh[first + 6] - (C2_XY * x * z) * sh[first + 7]
            color += (C2_XX * (xx - yy)) * sh[first + 8]
            if degree > 2:
                color -= (C3_0 * y * (3.0 * xx - yy)) * sh[first + 9]
                color += (C3_1 * x * y * z) * sh[first + 10]
                color -= (C3_2 * y * (4.0 * zz - xx - yy)) * sh[first + 11]
                color += (C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)) * sh[first + 12]
                color -= (C3_2 * x * (4.0 * zz - xx - yy)) * sh[first + 13]
                color += (C3_5 * z * (xx - yy)) * sh[first + 14]
                color -= (C3_0 * x * (xx - 3.0 * yy)) * sh[first + 15]
    return wp.max(color, wp.vec3(0.0))


class ShTerms(wp.types.vector(length=16, dtype=wp.float32)):
    """Values of the 16 SH basis functions up to degree 3 in one direction."""


@wp.func
def sh_terms(direction: wp.vec3) -> ShTerms:
    """Evaluates the SH basis functions along the unit ``direction``, with the signs of ``sh_color``."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    xx = x * x
    yy = y * y
    zz = z * z
    terms = ShTerms()
    terms[0] = C0
    terms[1] = -C1 * y
    terms[2] = C1 * z
    terms[3] = -C1 * x
    terms[4] = C2_XY * x * y
    terms[5] = -C2_XY * y * z
    terms[6] = C2_ZZ * (2.0 * zz - xx - yy)
    terms[7] = -C2_XY * x * z
    terms[8] = C2_XX * (xx - yy)
    terms[9] = -C3_0 * y * (3.0 * xx - yy)
    terms[10] = C3_1 * x * y * z
    terms[11] = -C3_2 * y * (4.0 * zz - xx - yy)
    terms[12] = C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    terms[13] = -C3_2 * x * (4.0 * zz - xx - yy)
    terms[14] = C3_5 * z * (xx - yy)
    terms[15] = -C3_0 * x * (xx - 3.0 * yy)
    return terms
