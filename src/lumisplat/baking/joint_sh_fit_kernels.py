"""Blends SH colours of Gaussians along rays, and applies the transpose (docs/method/relighting.md#baking).

A *contribution* is a Gaussian on a ray; contributions are sorted by ray. A thread works on one ray when colours are
blended, and on one Gaussian when errors are gathered.
"""

import warp as wp

from lumisplat.device.math.sh import sh_terms
from lumisplat.device.structs import struct

wp.set_module_options({"enable_backward": False})


@struct
class Contributions:
    """Pairs of a Gaussian and a ray on which it is blended, one array element each."""

    ray: wp.array[int]
    gaussian: wp.array[int]
    weight: wp.array[float]
    """Blend weight of the Gaussian in the ray's colour."""
    direction: wp.array[wp.vec3]
    """Unit direction from the camera to the Gaussian's mean, object space."""


@wp.kernel
def blend_sh(
    start: int,
    terms: int,
    shift: float,
    least: float,
    contributions: Contributions,
    first: wp.array[int],
    sh: wp.array2d[wp.vec3],
    color_out: wp.array[wp.vec3],
):
    """Blends the SH colours of Gaussians along each ray. One thread per ray.

    Args:
        start: Ray of the first thread.
        terms: SH coefficients per Gaussian.
        shift: Constant added to the colour of each Gaussian.
        least: Lower bound of each channel of a Gaussian's colour.
        contributions: Contributions, sorted by ray.
        first: Index of each ray's first contribution, followed by the number of contributions.
        sh: SH coefficients.
        color_out: Blended colours.
    """
    i = start + wp.tid()
    total = wp.vec3(0.0)
    for j in range(first[i], first[i + 1]):
        basis = sh_terms(contributions.direction[j])
        color = wp.vec3(shift)
        for k in range(terms):
            color += basis[k] * sh[contributions.gaussian[j], k]
        total += contributions.weight[j] * wp.max(color, wp.vec3(least))
    color_out[i] = total


@wp.kernel
def gather_errors(
    start: int,
    terms: int,
    contributions: Contributions,
    order: wp.array[int],
    first: wp.array[int],
    error: wp.array[wp.vec3],
    sh_inout: wp.array2d[wp.vec3],
):
    """Sums the errors of rays into SH coefficients, the transpose of `blend_sh`. One thread per Gaussian.

    Args:
        start: Gaussian of the first thread.
        terms: SH coefficients per Gaussian.
        contributions: Contributions, sorted by ray.
        order: Indices of the contributions, sorted by Gaussian.
        first: Each Gaussian's first position in ``order``, followed by the number of contributions.
        error: Errors of the rays.
        sh_inout: Sums; zero at the start.
    """
    i = start + wp.tid()
    for j in range(first[i], first[i + 1]):
        contribution = order[j]
        basis = sh_terms(contributions.direction[contribution])
        part = contributions.weight[contribution] * error[contributions.ray[contribution]]
        for k in range(terms):
            sh_inout[i, k] += basis[k] * part
