"""What rays show of Gaussians by their harmonics, and the transpose of that (docs/method/relighting.md#baking).

Rays and Gaussians meet in *sights*, sorted by ray. One item is a ray where colours are blended, and a Gaussian where
errors are gathered.
"""

import warp as wp

from lumisplat.device.math.sh import sh_terms
from lumisplat.device.structs import struct

wp.set_module_options({"enable_backward": False})


@struct
class Contributions:
    """A Gaussian on a ray."""

    ray: wp.array[int]
    gaussian: wp.array[int]
    weight: wp.array[float]
    """Of its colour in what the ray shows."""
    direction: wp.array[wp.vec3]
    """From the eye to its mean, its own space, unit."""


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
    """What rays show, a ray an item.

    Args:
        start: First item.
        terms: Coefficients of a Gaussian.
        shift: Added to the colour of each Gaussian.
        least: Below which no channel of these falls.
        contributions: Sorted by ray.
        first: Each ray's first sight, and their number at the end.
        sh: Coefficients.
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
    """Sums errors of rays into coefficients, a Gaussian an item.

    Args:
        start: First item.
        terms: Coefficients of a Gaussian.
        contributions: Sorted by ray.
        order: Sights sorted by Gaussian.
        first: Each Gaussian's first place in that order, and the number of sights at the end.
        error: Of rays.
        sh_inout: Receives the sums; zero before.
    """
    i = start + wp.tid()
    for j in range(first[i], first[i + 1]):
        contribution = order[j]
        basis = sh_terms(contributions.direction[contribution])
        part = contributions.weight[contribution] * error[contributions.ray[contribution]]
        for k in range(terms):
            sh_inout[i, k] += basis[k] * part
