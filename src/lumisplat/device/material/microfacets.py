"""Smooth and rough reflection and refraction: Fresnel, the GGX microfacet distribution, and rough glass.

Directions and normals are unit vectors; normals are on the side of the incident light. ``cosine`` is
``-dot(direction, normal)``. ``eta`` is the index of refraction on the side of the incident light over the index on the
other side.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

import numpy as np
import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.math.color import is_black, mean_of
from lumisplat.device.math.directions import INV_PI, TWO_PI
from lumisplat.device.structs.shading import Bsdf

GGX_WIDTH_MIN = 1e-6
"""Smallest GGX alpha of a rough highlight, as by roughness 0.001; float32 directions resolve no narrower one."""

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(8)

NODES = wp.constant(wp.types.vector(length=8, dtype=wp.float32)(*(0.5 * (_POINTS + 1.0)).tolist()))
"""Quadrature nodes, as square roots of cosines, for means of the Fresnel reflectance.

They are dense at grazing angles, where reflectances rise steeply."""

WEIGHTS = wp.constant(wp.types.vector(length=8, dtype=wp.float32)(*(0.5 * _WEIGHTS).tolist()))


@wp.func
def reflect(direction: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """Returns the direction in which a surface with this normal reflects an incident direction."""
    return wp.normalize(direction - 2.0 * wp.dot(direction, normal) * normal)


@wp.func
def cosine2_beyond(cosine: float, eta: float) -> float:
    """Returns the squared cosine of the angle of refraction; at most 0 under total internal reflection.

    It is ``1 - eta^2 (1 - cosine^2)``, computed without cancellation for nearly equal indices.
    """
    return (1.0 - eta) * (1.0 + eta) + eta * eta * cosine * cosine


@wp.func
def refract(direction: wp.vec3, normal: wp.vec3, eta: float) -> wp.vec3:
    """Returns the refracted direction; there must be no total internal reflection."""
    cosine = -wp.dot(direction, normal)
    beyond = wp.sqrt(wp.max(cosine2_beyond(cosine, eta), 0.0))
    return wp.normalize(eta * direction + (eta * cosine - beyond) * normal)


@wp.func
def fresnel(cosine: float, eta: float) -> float:
    """Returns the Fresnel reflectance of a dielectric for unpolarised light; 1 under total internal reflection."""
    beyond2 = cosine2_beyond(cosine, eta)
    if beyond2 <= 0.0:
        return 1.0
    beyond = wp.sqrt(beyond2)
    across = (eta * cosine - beyond) / (eta * cosine + beyond)
    along = (cosine - eta * beyond) / (cosine + eta * beyond)
    return 0.5 * (across * across + along * along)


@wp.func
def dielectric_share(strength: float, cosine: float, eta: float) -> float:
    """Returns ``strength`` times the Fresnel reflectance of a dielectric; 1 under total internal reflection."""
    if cosine2_beyond(cosine, eta) <= 0.0:
        return 1.0
    return strength * fresnel(cosine, eta)


@wp.func
def mean_fresnel(eta: float) -> float:
    """Returns the fraction of uniform hemispherical illumination that a smooth dielectric reflects.

    The light arrives on the side of the lower index of refraction. The error is at most 7e-6.
    """
    ratio = wp.min(eta, 1.0 / eta)
    total = float(0.0)
    for k in range(8):
        root = NODES[k]
        total += 4.0 * WEIGHTS[k] * root * root * root * fresnel(root * root, ratio)
    return total


@wp.func
def mean_dielectric_share(strength: float, fresnel_mean: float, eta: float) -> float:
    """Returns the fraction of uniform hemispherical illumination that a smooth dielectric reflects.

    ``strength`` scales the reflection. ``fresnel_mean`` is the fraction on the side of the lower index at strength 1.
    If ``eta`` is above 1, the light arrives on the side of the higher index; total reflection then lets at most 1 /
    eta^2 of it cross.
    """
    mean = strength * fresnel_mean
    if eta > 1.0:
        return 1.0 - (1.0 - mean) / (eta * eta)
    return mean


@wp.func
def schlick(head_on: wp.vec3, cosine: float) -> wp.vec3:
    """Returns a metal's linear reflectance at a cosine (Schlick 1994); at normal incidence, it is ``head_on``."""
    grazing = wp.pow(wp.clamp(1.0 - cosine, 0.0, 1.0), 5.0)
    return head_on + grazing * (wp.vec3(1.0) - head_on)


# --- The GGX distribution (Trowbridge and Reitz 1975, Walter et al. 2007) ---
#
# ``alpha`` is roughness squared, above 0. Cosines are relative to the surface normal, above 0. No angle comes from a
# cosine near 1: sines come from cross products, so that highlights of any width keep their shape in float32.

ALPHA_GGX_MIN = wp.constant(wp.float32(GGX_WIDTH_MIN))

HALF_MIN2 = wp.constant(wp.float32(1e-12))
"""If ``view + light`` has a squared length below this value, its direction is only rounding error."""


@wp.func
def ggx_d(normal: wp.vec3, half: wp.vec3, alpha: float) -> float:
    """Returns GGX's D, the area of microfacets with normal ``half`` per steradian and per area of the surface.

    D is ``alpha^2 / (pi (alpha^2 cos^2 + sin^2)^2)`` of the angle between ``normal`` and ``half``. ``half`` may have
    any length.
    """
    across = wp.cross(normal, half)
    return ggx_of_parts(wp.dot(normal, half), wp.dot(across, across), wp.dot(half, half), alpha)


@wp.func
def ggx_of_parts(along: float, across2: float, half2: float, alpha: float) -> float:
    """Returns ``ggx_d`` from ``dot(normal, half)``, ``|cross(normal, half)|^2`` and ``|half|^2``."""
    alpha2 = alpha * alpha
    spread = (alpha2 * along * along + across2) / half2
    return INV_PI * alpha2 / (spread * spread)


@wp.func
def smith_g1(cosine: float, alpha: float) -> float:
    """Returns ``G1 / (2 cosine)``; Smith's G1 is the unmasked fraction of GGX microfacets at a cosine (Heitz 2014)."""
    alpha2 = alpha * alpha
    return 1.0 / (cosine + wp.sqrt(alpha2 + (1.0 - alpha2) * cosine * cosine))


# The directional albedo of the highlight is linear in the reflectances: the one at normal incidence times
# ``1 - lost - rising`` plus the one at grazing incidence times ``rising``. Both factors are fits to quadrature that
# rather leave too little to the diffuse lobe (docs/adr/0009); they are exact for smooth surfaces.


@wp.func
def rising_share(cosine: float, alpha: float) -> float:
    """Returns a fit of the albedo of a GGX highlight whose microfacets reflect Schlick's ``(1 - cosine)^5``.

    The fit is up to 0.08 too large at grazing angles.
    """
    x = wp.max(1.0 - cosine, 0.0)
    above = cosine * x * x + 2.3 * alpha
    below = cosine + alpha * (2.48 + alpha * (38.2 + alpha * 24.7))
    return x * x * x * above / wp.max(below, 1e-30)


@wp.func
def lost_share(cosine: float, alpha: float) -> float:
    """Returns a fit of the fraction of light that a white GGX highlight loses by masking and shadowing.

    The fit is up to 0.12 too small at grazing angles.
    """
    above = alpha * alpha * (0.53 + 0.79 * cosine)
    below = cosine * cosine + alpha * (1.15 - 0.91 * cosine + 0.74 * alpha)
    return above / wp.max(below, 1e-30)


@wp.func
def mean_rising_share(alpha: float) -> float:
    """Returns a lower bound of the mean of ``rising_share`` over all views, weighted by their cosines."""
    return 1.0 / (21.0 + alpha * (50.4 + alpha * 357.0))


@wp.func
def mean_lost_share(alpha: float) -> float:
    """Returns an upper bound of the mean of ``lost_share`` over all views, weighted by their cosines."""
    return alpha * alpha / (0.26 + alpha * (1.05 + alpha * 0.3))


@wp.func
def rescattered_share(head_on: wp.vec3, alpha: float) -> wp.vec3:
    """Returns which fraction, per channel, of the light lost by single scattering a rough metal scatters again.

    At each further bounce between microfacets, the reflectance is the metal's mean one, and light leaves as from a
    white metal (Kulla and Conty 2017). ``head_on`` is the metal's reflectance at normal incidence. The result is 0 for
    ``alpha`` 0, where nothing is lost.
    """
    if alpha <= 0.0:
        return wp.vec3(0.0)
    lost = mean_lost_share(alpha)
    facets = head_on + (wp.vec3(1.0) - head_on) / 21.0  # mean of Schlick's reflectance
    leaves = wp.cw_mul(facets, facets) * (1.0 - lost)
    return wp.cw_div(leaves, wp.vec3(1.0) - lost * facets)


@wp.func
def rescattered_eval(share: wp.vec3, cos_view: float, cos_light: float, alpha: float) -> wp.vec3:
    """Evaluates the BSDF of multiple scattering: ``share * lost(view) * lost(light) / (pi * mean lost)``.

    ``share`` is ``rescattered_share``; lost is ``lost_share`` at a cosine.
    """
    lost = lost_share(cos_view, alpha) * lost_share(cos_light, alpha)
    return (INV_PI * lost / mean_lost_share(alpha)) * share


@wp.func
def sample_ggx_vndf(view: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Samples a microfacet normal visible to ``view`` (Heitz 2018; spherical caps of Dupuy and Benyoub 2023).

    ``view`` and the returned normal are in the frame in which the surface normal is z. The pdf of the returned normal
    is ``2 D G1 / (2 cosine) * dot(view, facet)``.
    """
    axis = wp.normalize(wp.vec3(alpha * view[0], alpha * view[1], view[2]))
    angle = TWO_PI * u[0]
    z = (1.0 - u[1]) * (1.0 + axis[2]) - axis[2]
    sine = wp.sqrt(wp.max((1.0 - z) * (1.0 + z), 0.0))
    cap = wp.vec3(sine * wp.cos(angle), sine * wp.sin(angle), z) + axis
    return wp.normalize(wp.vec3(alpha * cap[0], alpha * cap[1], wp.max(cap[2], 0.0)))


# --- Rough, opaque surfaces of ior 1.5 ---
#
# They equal ``pbr_eval`` without layers, transmission and energy compensation
# (docs/method/materials.md#metallic-roughness).

HEAD_ON = wp.constant(wp.float32(COAT_HEAD_ON))


@wp.func
def mirrored(cosine: float, alpha: float) -> float:
    """Returns the fraction of light arriving at a cosine that a rough dielectric with F0 = 0.04 reflects specularly."""
    rising = rising_share(cosine, alpha)
    return HEAD_ON * (1.0 - lost_share(cosine, alpha) - rising) + rising


@wp.func
def diffuse_factor(cos_view: float, cos_light: float, alpha: float) -> float:
    """Returns the BSDF of a rough dielectric's diffuse lobe for a white base colour, F0 = 0.04."""
    rising = mean_rising_share(alpha)
    mean = HEAD_ON * (1.0 - mean_lost_share(alpha) - rising) + rising
    return INV_PI * (1.0 - mirrored(cos_light, alpha)) * (1.0 - mirrored(cos_view, alpha)) / (1.0 - mean)


@wp.func
def highlight_parts(normal: wp.vec3, view: wp.vec3, light: wp.vec3, alpha: float) -> wp.vec2:
    """Returns the two parts of the BSDF of a GGX highlight: the first times F0, plus the second.

    F0 is the reflectance at normal incidence; at grazing incidence it rises to 1 (Schlick 1994). The light must be
    above the horizon.
    """
    half = view + light
    x = wp.max(1.0 - 0.5 * wp.length(half), 0.0)
    rising = x * x * x * x * x
    masks = smith_g1(wp.dot(normal, view), alpha) * smith_g1(wp.dot(normal, light), alpha)
    facets = ggx_d(normal, half, alpha) * masks
    return wp.vec2((1.0 - rising) * facets, rising * facets)


@wp.func
def highlight_factor(normal: wp.vec3, view: wp.vec3, light: wp.vec3, alpha: float) -> float:
    """Returns the BSDF of a rough dielectric's GGX highlight, F0 = 0.04, equal in all channels."""
    parts = highlight_parts(normal, view, light, alpha)
    return HEAD_ON * parts[0] + parts[1]


@wp.func
def opaque_eval(
    normal: wp.vec3,
    color: wp.vec3,
    roughness: float,
    metallic: float,
    view: wp.vec3,
    light: wp.vec3,
    spread: float,
) -> wp.vec3:
    """Evaluates the metallic-roughness BSDF, per steradian, without the cosine; light and view are above the horizon.

    ``spread`` is added to the highlight's squared alpha.
    """
    alpha = roughness * roughness
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    parts = highlight_parts(normal, view, light, wp.sqrt(alpha * alpha + spread))
    head_on = wp.vec3((1.0 - metallic) * HEAD_ON) + metallic * color
    diffuse = (1.0 - metallic) * diffuse_factor(cos_view, cos_light, alpha)
    return diffuse * color + parts[0] * head_on + wp.vec3(parts[1])


@wp.func
def opaque_dot(
    normal: wp.vec3,
    color: wp.vec3,
    roughness: float,
    metallic: float,
    view: wp.vec3,
    light: wp.vec3,
    spread: float,
    weights: wp.vec3,
) -> wp.float32:
    """Returns the cosine times the dot product of ``weights`` and ``opaque_eval``, for Warp to differentiate."""
    return wp.dot(normal, light) * wp.dot(weights, opaque_eval(normal, color, roughness, metallic, view, light, spread))


# --- Rough dielectrics that transmit, and thin walls (docs/method/materials.md#rough-glass) ---
#
# Directions are unit vectors away from the surface; ``view`` is on the side of ``normal``, ``light`` on either side.
# Radiance is divided by the square of its medium's index of refraction, so that refraction neither gains nor loses
# light, as at smooth surfaces.

BEND_MIN = wp.constant(wp.float32(1e-3))
"""The ratio of indices by which rough glass refracts differs from 1 by at least this.

At a ratio of 1, the lobe would be a single direction."""


@wp.func
def transmits(bsdf: Bsdf) -> bool:
    """Returns whether the surface is rough glass, through which light passes into a lobe of directions."""
    return not is_black(bsdf.transmitted)


@wp.func
def bending(eta: float) -> float:
    """Returns ``eta`` or, if it is closer to 1 than ``BEND_MIN``, ``1 + BEND_MIN`` or ``1 - BEND_MIN``."""
    if wp.abs(eta - 1.0) >= BEND_MIN:
        return eta
    return wp.where(eta > 1.0, 1.0 + BEND_MIN, 1.0 - BEND_MIN)


@wp.func
def facet_of(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Returns the unit normal, on the view's side, of the microfacet that sends light from ``light`` to ``view``.

    It reflects if ``light`` is above the horizon, else it refracts. Zero: no microfacet does.
    """
    half = view + light
    if wp.dot(normal, light) <= 0.0:
        if bsdf.thin_walled:
            half = view + light - 2.0 * wp.dot(normal, light) * normal
        else:
            half = -(bending(bsdf.eta) * view + light)
    if wp.dot(half, half) <= HALF_MIN2:
        return wp.vec3(0.0)
    if wp.dot(half, normal) < 0.0:
        half = -half
    return wp.normalize(half)


@wp.func
def facet_reflectance(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the reflectance of a microfacet: Fresnel for the dielectric, Schlick for the metal."""
    dielectric = dielectric_share(bsdf.dielectric, cosine, bsdf.eta)
    x = wp.max(1.0 - cosine, 0.0)
    rising = x * x * x * x * x
    metal = (1.0 - rising) * bsdf.metal + wp.vec3(rising * bsdf.metallic)
    return wp.vec3((1.0 - bsdf.metallic) * dielectric) + metal


@wp.func
def facet_transmittance(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the transmittance, per channel, of a microfacet of rough glass at a cosine from its normal."""
    return (1.0 - dielectric_share(bsdf.dielectric, cosine, bsdf.eta)) * bsdf.transmitted


@wp.func
def reflected_chance(bsdf: Bsdf, cosine: float) -> float:
    """Returns the probability with which a sampled microfacet of rough glass reflects instead of transmitting.

    It is ``reflectance / (reflectance + transmittance)`` at a cosine from its normal.
    """
    reflected = mean_of(facet_reflectance(bsdf, cosine))
    through = mean_of(facet_transmittance(bsdf, cosine))
    if through <= 0.0:
        return 1.0
    return reflected / (reflected + through)


@wp.func
def spread_of_facets(bsdf: Bsdf, to_view: float, to_light: float) -> float:
    """Returns the Jacobian of transmission: solid angle of microfacet normals per solid angle of transmitted light.

    ``to_view`` and ``to_light`` are the cosines of view and light to the microfacet's normal.
    """
    if bsdf.thin_walled:
        return 0.25 / to_view
    bend = bending(bsdf.eta) * to_view + to_light
    return wp.abs(to_light) / wp.max(bend * bend, HALF_MIN2)


@wp.func
def glass_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the microfacet BSDF of rough glass, per steradian, linear, without the cosine."""
    half = facet_of(bsdf, normal, view, light)
    to_view = wp.dot(view, half)
    to_light = wp.dot(light, half)
    if to_view <= 0.0:
        return wp.vec3(0.0)
    alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    cos_light = wp.dot(normal, light)
    facets = ggx_d(normal, half, alpha) * smith_g1(wp.dot(normal, view), alpha) * smith_g1(wp.abs(cos_light), alpha)
    if cos_light > 0.0:
        return facets * facet_reflectance(bsdf, to_view)
    if to_light >= 0.0 and not bsdf.thin_walled:
        return wp.vec3(0.0)
    return (4.0 * to_view * spread_of_facets(bsdf, to_view, to_light) * facets) * facet_transmittance(bsdf, to_view)


@wp.func
def glass_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf, per steradian, with which the microfacets of rough glass reflect or refract to ``light``."""
    half = facet_of(bsdf, normal, view, light)
    to_view = wp.dot(view, half)
    to_light = wp.dot(light, half)
    if to_view <= 0.0:
        return 0.0
    alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    facet_pdf = 2.0 * ggx_d(normal, half, alpha) * smith_g1(wp.dot(normal, view), alpha) * to_view
    chance = reflected_chance(bsdf, to_view)
    if wp.dot(normal, light) > 0.0:
        return chance * facet_pdf * 0.25 / to_view
    if to_light >= 0.0 and not bsdf.thin_walled:
        return 0.0
    return (1.0 - chance) * facet_pdf * spread_of_facets(bsdf, to_view, to_light)


@wp.func
def glass_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, half: wp.vec3, choice: float) -> wp.vec3:
    """Returns the direction from which a microfacet of rough glass sends light to ``view``.

    ``half`` is the microfacet's normal; ``choice``, random, 0..1, selects reflection or transmission. Zero: another
    microfacet blocks the light.
    """
    to_view = wp.dot(view, half)
    reflected = wp.normalize(2.0 * to_view * half - view)
    is_lost = wp.dot(normal, reflected) <= 0.0
    found = reflected
    if choice >= reflected_chance(bsdf, to_view):
        if bsdf.thin_walled:
            found = reflected - 2.0 * wp.dot(normal, reflected) * normal
        else:
            found = refract(-view, half, bending(bsdf.eta))
            is_lost = wp.dot(normal, found) >= 0.0
    if is_lost:
        return wp.vec3(0.0)
    return found


@wp.func
def glass_share(bsdf: Bsdf, cos_view: float) -> float:
    """Returns the probability with which rough glass samples microfacets instead of the diffuse lobe."""
    reflected = dielectric_share(bsdf.dielectric, cos_view, bsdf.eta)
    facets = (1.0 - bsdf.metallic) * reflected + mean_of(bsdf.metal) + (1.0 - reflected) * mean_of(bsdf.transmitted)
    diffuse = (1.0 - reflected) * mean_of(bsdf.diffuse)
    if diffuse <= 0.0:
        return 1.0
    return facets / (facets + diffuse)
