"""Weights of neighbouring pixels in the spatial filters of real-time light (docs/method/realtime.md#filters)."""

import warp as wp

LUMINANCE_SIGMAS = 4.0
"""Scale of the weight by luminance difference, as in SVGF: a neighbour's weight is a falloff of the difference divided
by this many standard deviations of the noise."""

WEIGHT_LEAST = 1e-8
"""A neighbour is ignored if its position weight times its normal weight is below this value, so that surfaces at an
angle give no light to pixels without samples."""

WEIGHT_MIN = wp.constant(wp.float32(WEIGHT_LEAST))
SIGMAS = wp.constant(wp.float32(LUMINANCE_SIGMAS))
TINY = wp.constant(wp.float32(1e-16))


@wp.func
def falloff(x: float) -> float:
    """Returns a smooth approximation of exp(-x^2 / 3) that is exactly 0 from x = 3 on."""
    return falloff_by_square(x * x)


@wp.func
def falloff_by_square(x2: float) -> float:
    """Returns `falloff` of the square root of ``x2``."""
    rest = wp.max(1.0 - x2 / 9.0, 0.0)
    return rest * rest * rest


@wp.func
def share_within(distance: float, tolerated: float) -> float:
    """Returns the fraction that a history keeps: 1 up to a tolerated distance from new samples, then its 4th power."""
    if distance <= tolerated:
        return 1.0
    ratio = tolerated / distance
    return ratio * ratio * ratio * ratio


@wp.func
def step_weight(row: int, column: int, radius: int) -> float:
    """Returns the weight of a neighbour by its place in a kernel of ``radius`` neighbours to each side."""
    return falloff(1.5 * float(row * row + column * column) / float(radius * radius + 1))


@wp.func
def luminance_weight(difference: float, variance: float) -> float:
    """Returns a neighbour's weight by the difference between its luminance and the pixel's.

    ``variance`` is that of the luminances: the product of both standard deviations.
    """
    return falloff_by_square(difference * difference / wp.max(SIGMAS * SIGMAS * variance, TINY))


@wp.func
def normal_weight(cosine: float, extent: float) -> float:
    """Returns a neighbour's weight: the cosine between the two normals, to the power 8 (Gaussians) or 64 (meshes).

    ``extent`` is the Gaussian's size; 0 for meshes.
    """
    power = wp.max(cosine, 0.0)
    power *= power
    power *= power
    power *= power
    if extent > 0.0:
        return power
    power *= power
    power *= power
    return power * power
