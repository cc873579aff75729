"""Rough highlights: the GGX distribution of microfacets (Trowbridge and Reitz 1975, Walter et al. 2007).

``alpha`` is alpha, roughness squared, above 0. Cosines are those with the surface's normal, above 0. No angle is taken
from a cosine near 1: sines come from cross products, so that highlights of any width keep their shape in float32.

The equations are in docs/method/materials.md#metallic-roughness.
"""

import math

import warp as wp

from lumisplat.constants import GGX_WIDTH_MIN
from lumisplat.device.math.directions import TWO_PI

wp.set_module_options({"enable_backward": False})

ALPHA_GGX_MIN = wp.constant(wp.float32(GGX_WIDTH_MIN))
INV_PI = wp.constant(wp.float32(1.0 / math.pi))
HALF_MIN2 = wp.constant(wp.float32(1e-12))
"""Squared length of view + light below which rounding decides where it points."""


@wp.func
def ggx_d(normal: wp.vec3, half: wp.vec3, alpha: float) -> float:
    """D: area of the microfacets square to ``half`` (of any length), per steradian and area of the surface.

    ``width^2 / (pi (width^2 cos^2 + sin^2)^2)`` of the angle between the two.
    """
    alpha2 = alpha * alpha
    across = wp.cross(normal, half)
    along = wp.dot(normal, half)
    spread = (alpha2 * along * along + wp.dot(across, across)) / wp.dot(half, half)
    return INV_PI * alpha2 / (spread * spread)


@wp.func
def smith_g1(cosine: float, alpha: float) -> float:
    """Smith's G1 over twice the cosine: how much of the microfacets is seen from there (Heitz 2014)."""
    alpha2 = alpha * alpha
    return 1.0 / (cosine + wp.sqrt(alpha2 + (1.0 - alpha2) * cosine * cosine))


# What a highlight sends to a view of a white sky is linear in the reflectances: that at normal incidence times
# ``1 - lost - rising``, that at grazing incidence times ``rising``. Both are fits to quadrature, and err to the side on
# which less is left for diffuse light (docs/adr/0009); they are exact where the surface is smooth.


@wp.func
def rising_share(cosine: float, alpha: float) -> float:
    """What Schlick's ``(1 - cosine)^5`` reflects; up to 0.08 too much, at grazing angles."""
    x = wp.max(1.0 - cosine, 0.0)
    above = cosine * x * x + 2.3 * alpha
    below = cosine + alpha * (2.48 + alpha * (38.2 + alpha * 24.7))
    return x * x * x * above / wp.max(below, 1e-30)


@wp.func
def lost_share(cosine: float, alpha: float) -> float:
    """What microfacets lose to each other's shadow; up to 0.12 too little, at grazing angles."""
    above = alpha * alpha * (0.53 + 0.79 * cosine)
    below = cosine * cosine + alpha * (1.15 - 0.91 * cosine + 0.74 * alpha)
    return above / wp.max(below, 1e-30)


@wp.func
def mean_rising_share(alpha: float) -> float:
    """No more than its mean over all views, weighted by the cosine."""
    return 1.0 / (21.0 + alpha * (50.4 + alpha * 357.0))


@wp.func
def mean_lost_share(alpha: float) -> float:
    """No less than its mean."""
    return alpha * alpha / (0.26 + alpha * (1.05 + alpha * 0.3))


@wp.func
def sample_ggx_vndf(view: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """A microfacet's normal, as often as ``view`` sees it (Heitz 2018, by the caps of Dupuy and Benyoub 2023).

    Both in the frame in which the surface's normal is z; its density is ``2 D G1 / (2 cosine) * dot(view, facet)``.
    """
    axis = wp.normalize(wp.vec3(alpha * view[0], alpha * view[1], view[2]))
    angle = TWO_PI * u[0]
    z = (1.0 - u[1]) * (1.0 + axis[2]) - axis[2]
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    cap = wp.vec3(sine * wp.cos(angle), sine * wp.sin(angle), z) + axis
    return wp.normalize(wp.vec3(alpha * cap[0], alpha * cap[1], wp.max(cap[2], 0.0)))
