"""Rough highlights: the GGX distribution of microfacets (Trowbridge and Reitz 1975, Walter et al. 2007).

``alpha`` is roughness squared, above 0. Cosines are those with the surface's normal, above 0. No angle is taken from a
cosine near 1: sines come from cross products, so that highlights of any width keep their shape in float32.

The equations are in docs/method/materials.md#metallic-roughness.
"""

import warp as wp

from lumisplat.constants import GGX_WIDTH_MIN
from lumisplat.device.math.directions import INV_PI, TWO_PI

wp.set_module_options({"enable_backward": False})

ALPHA_GGX_MIN = wp.constant(wp.float32(GGX_WIDTH_MIN))

HALF_MIN2 = wp.constant(wp.float32(1e-12))
"""Squared length of view + light below which its direction is rounding error."""


@wp.func
def ggx_d(normal: wp.vec3, half: wp.vec3, alpha: float) -> float:
    """D: area of the microfacets with normal ``half`` (of any length), per steradian and area of the surface.

    ``alpha^2 / (pi (alpha^2 cos^2 + sin^2)^2)`` of the angle between the two normals.
    """
    alpha2 = alpha * alpha
    across = wp.cross(normal, half)
    along = wp.dot(normal, half)
    spread = (alpha2 * along * along + wp.dot(across, across)) / wp.dot(half, half)
    return INV_PI * alpha2 / (spread * spread)


@wp.func
def smith_g1(cosine: float, alpha: float) -> float:
    """Smith's G1, the share of microfacets that are not masked, over twice the cosine (Heitz 2014)."""
    alpha2 = alpha * alpha
    return 1.0 / (cosine + wp.sqrt(alpha2 + (1.0 - alpha2) * cosine * cosine))


# The directional albedo of the highlight is linear in the reflectances: that at normal incidence times
# ``1 - lost - rising``, that at grazing incidence times ``rising``. Both are fits to quadrature, and err on the side
# that leaves less to diffuse light (docs/adr/0009); they are exact for smooth surfaces.


@wp.func
def rising_share(cosine: float, alpha: float) -> float:
    """Share that Schlick's ``(1 - cosine)^5`` reflects; up to 0.08 too much, at grazing angles."""
    x = wp.max(1.0 - cosine, 0.0)
    above = cosine * x * x + 2.3 * alpha
    below = cosine + alpha * (2.48 + alpha * (38.2 + alpha * 24.7))
    return x * x * x * above / wp.max(below, 1e-30)


@wp.func
def lost_share(cosine: float, alpha: float) -> float:
    """Share lost by masking and shadowing of microfacets; up to 0.12 too little, at grazing angles."""
    above = alpha * alpha * (0.53 + 0.79 * cosine)
    below = cosine * cosine + alpha * (1.15 - 0.91 * cosine + 0.74 * alpha)
    return above / wp.max(below, 1e-30)


@wp.func
def mean_rising_share(alpha: float) -> float:
    """A lower bound of ``rising_share``'s mean over all views, weighted by the cosine."""
    return 1.0 / (21.0 + alpha * (50.4 + alpha * 357.0))


@wp.func
def mean_lost_share(alpha: float) -> float:
    """An upper bound of ``lost_share``'s mean over all views, weighted by the cosine."""
    return alpha * alpha / (0.26 + alpha * (1.05 + alpha * 0.3))


@wp.func
def rescattered_share(head_on: wp.vec3, alpha: float) -> wp.vec3:
    """Of what single scattering loses in a metal, the share that is reflected after all (Kulla and Conty 2017).

    Each time, light leaves with the mean albedo of white, or meets another facet.

    Args:
        head_on: Reflectance of the metal at normal incidence.
        alpha: Of the facets; smooth ones lose nothing.
    """
    if alpha <= 0.0:
        return wp.vec3(0.0)
    lost = mean_lost_share(alpha)
    facets = head_on + (wp.vec3(1.0) - head_on) / 21.0  # mean of Schlick's reflectance
    leaves = wp.cw_mul(facets, facets) * (1.0 - lost)
    return wp.cw_div(leaves, wp.vec3(1.0) - lost * facets)


@wp.func
def rescattered_eval(share: wp.vec3, cos_view: float, cos_light: float, alpha: float) -> wp.vec3:
    """BSDF of that share: even, but for what each direction loses."""
    lost = lost_share(cos_view, alpha) * lost_share(cos_light, alpha)
    return (INV_PI * lost / mean_lost_share(alpha)) * share


@wp.func
def sample_ggx_vndf(view: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """A normal of the microfacets visible to ``view`` (Heitz 2018, by the spherical caps of Dupuy and Benyoub 2023).

    Both in the frame in which the surface's normal is z; its density is ``2 D G1 / (2 cosine) * dot(view, facet)``.
    """
    axis = wp.normalize(wp.vec3(alpha * view[0], alpha * view[1], view[2]))
    angle = TWO_PI * u[0]
    z = (1.0 - u[1]) * (1.0 + axis[2]) - axis[2]
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    cap = wp.vec3(sine * wp.cos(angle), sine * wp.sin(angle), z) + axis
    return wp.normalize(wp.vec3(alpha * cap[0], alpha * cap[1], wp.max(cap[2], 0.0)))
