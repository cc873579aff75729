"""Rough highlights: the GGX distribution of microfacets (Trowbridge and Reitz 1975, Walter et al. 2007).

``width`` is alpha, roughness squared, above 0. Cosines are those with the surface's normal, above 0. No angle is taken
from a cosine near 1: sines come from cross products, so that highlights of any width keep their shape in float32.
"""

import math

import warp as wp

from lumisplat.constants import GGX_WIDTH_MIN
from lumisplat.device.math.directions import TWO_PI

wp.set_module_options({"enable_backward": False})

WIDTH_MIN = wp.constant(wp.float32(GGX_WIDTH_MIN))
INV_PI = wp.constant(wp.float32(1.0 / math.pi))
HALF_MIN2 = wp.constant(wp.float32(1e-12))
"""Squared length of view + light below which rounding decides where it points."""


@wp.func
def facet_density(normal: wp.vec3, half: wp.vec3, width: float) -> float:
    """D: area of the microfacets square to ``half`` (of any length), per steradian and area of the surface.

    ``width^2 / (pi (width^2 cos^2 + sin^2)^2)`` of the angle between the two.
    """
    width2 = width * width
    across = wp.cross(normal, half)
    along = wp.dot(normal, half)
    spread = (width2 * along * along + wp.dot(across, across)) / wp.dot(half, half)
    return INV_PI * width2 / (spread * spread)


@wp.func
def masking(cosine: float, width: float) -> float:
    """Smith's G1 over twice the cosine: how much of the microfacets is seen from there (Heitz 2014)."""
    width2 = width * width
    return 1.0 / (cosine + wp.sqrt(width2 + (1.0 - width2) * cosine * cosine))


# What a highlight sends to a view of a white sky is linear in the reflectances: that at normal incidence times
# ``1 - lost - rising``, that at grazing incidence times ``rising``. Both are fits to quadrature, and err to the side on
# which less is left for diffuse light (docs/adr/0009); they are exact where the surface is smooth.


@wp.func
def rising_share(cosine: float, width: float) -> float:
    """What Schlick's ``(1 - cosine)^5`` reflects; up to 0.08 too much, at grazing angles."""
    x = wp.max(1.0 - cosine, 0.0)
    above = cosine * x * x + 2.3 * width
    below = cosine + width * (2.48 + width * (38.2 + width * 24.7))
    return x * x * x * above / wp.max(below, 1e-30)


@wp.func
def lost_share(cosine: float, width: float) -> float:
    """What microfacets lose to each other's shadow; up to 0.12 too little, at grazing angles."""
    above = width * width * (0.53 + 0.79 * cosine)
    below = cosine * cosine + width * (1.15 - 0.91 * cosine + 0.74 * width)
    return above / wp.max(below, 1e-30)


@wp.func
def mean_rising_share(width: float) -> float:
    """No more than its mean over all views, weighted by the cosine."""
    return 1.0 / (21.0 + width * (50.4 + width * 357.0))


@wp.func
def mean_lost_share(width: float) -> float:
    """No less than its mean."""
    return width * width / (0.26 + width * (1.05 + width * 0.3))


@wp.func
def visible_facet(view: wp.vec3, width: float, u: wp.vec2) -> wp.vec3:
    """A microfacet's normal, as often as ``view`` sees it (Heitz 2018, by the caps of Dupuy and Benyoub 2023).

    Both in the frame in which the surface's normal is z; its density is ``2 D G1 / (2 cosine) * dot(view, facet)``.
    """
    axis = wp.normalize(wp.vec3(width * view[0], width * view[1], view[2]))
    angle = TWO_PI * u[0]
    z = (1.0 - u[1]) * (1.0 + axis[2]) - axis[2]
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    cap = wp.vec3(sine * wp.cos(angle), sine * wp.sin(angle), z) + axis
    return wp.normalize(wp.vec3(width * cap[0], width * cap[1], wp.max(cap[2], 0.0)))
