"""Rough dielectrics that transmit: reflection and refraction at microfacets (Walter et al. 2007), and thin walls.

Directions are unit vectors away from the surface; ``view`` is on the side of ``normal``, ``light`` on either side.
Radiance counts over the square of its medium's index of refraction: no light is gained or lost where rays are bent, as
at smooth surfaces.

The equations are in docs/method/materials.md#rough-glass.
"""

import warp as wp

from lumisplat.device.material.fresnel import dielectric_share, refract
from lumisplat.device.material.ggx import ALPHA_GGX_MIN, HALF_MIN2, ggx_d, smith_g1
from lumisplat.device.math.color import is_black, mean_of
from lumisplat.device.structs.light import Bsdf

wp.set_module_options({"enable_backward": False})

BEND_MIN = wp.constant(wp.float32(1e-3))
"""Least difference of the indices' ratio from 1 by which rays are bent: with none, there is one direction only."""


@wp.func
def transmits(bsdf: Bsdf) -> bool:
    """Whether light arrives through the surface, over a lobe of directions."""
    return not is_black(bsdf.transmitted)


@wp.func
def bending(eta: float) -> float:
    """The ratio of the indices, but not 1."""
    if wp.abs(eta - 1.0) >= BEND_MIN:
        return eta
    return wp.where(eta > 1.0, 1.0 + BEND_MIN, 1.0 - BEND_MIN)


@wp.func
def facet_of(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Normal of the microfacet that sends light to the view, unit, on the side of the view; zero: there is none."""
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
    """What a microfacet mirrors: Fresnel's share of the dielectric, and Schlick's of the metal."""
    dielectric = dielectric_share(bsdf.dielectric, cosine, bsdf.eta)
    x = wp.max(1.0 - cosine, 0.0)
    rising = x * x * x * x * x
    metal = (1.0 - rising) * bsdf.metal + wp.vec3(rising * bsdf.metallic)
    return wp.vec3((1.0 - bsdf.metallic) * dielectric) + metal


@wp.func
def facet_transmittance(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """What a microfacet lets through."""
    return (1.0 - dielectric_share(bsdf.dielectric, cosine, bsdf.eta)) * bsdf.transmitted


@wp.func
def reflected_chance(bsdf: Bsdf, cosine: float) -> float:
    """Probability with which a sampled microfacet reflects, and does not transmit."""
    reflected = mean_of(facet_reflectance(bsdf, cosine))
    through = mean_of(facet_transmittance(bsdf, cosine))
    if through <= 0.0:
        return 1.0
    return reflected / (reflected + through)


@wp.func
def spread_of_facets(bsdf: Bsdf, to_view: float, to_light: float) -> float:
    """Solid angle of microfacets' normals over that of the light behind the surface that they send to the view."""
    if bsdf.thin_walled:
        return 0.25 / to_view
    bend = bending(bsdf.eta) * to_view + to_light
    return wp.abs(to_light) / wp.max(bend * bend, HALF_MIN2)


@wp.func
def glass_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """What microfacets send to ``view`` over irradiance from ``light``, per steradian, linear; without the cosine."""
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
    """Density with which ``glass_sample`` samples ``light``, per steradian."""
    half = facet_of(bsdf, normal, view, light)
    to_view = wp.dot(view, half)
    to_light = wp.dot(light, half)
    if to_view <= 0.0:
        return 0.0
    alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    seen = 2.0 * ggx_d(normal, half, alpha) * smith_g1(wp.dot(normal, view), alpha) * to_view
    chance = reflected_chance(bsdf, to_view)
    if wp.dot(normal, light) > 0.0:
        return chance * seen * 0.25 / to_view
    if to_light >= 0.0 and not bsdf.thin_walled:
        return 0.0
    return (1.0 - chance) * seen * spread_of_facets(bsdf, to_view, to_light)


@wp.func
def glass_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, half: wp.vec3, choice: float) -> wp.vec3:
    """Where light comes from that a sampled microfacet sends to the view; zero: from another microfacet.

    Args:
        bsdf: The material.
        normal: Unit.
        view: Unit, away from the surface.
        half: Normal of the microfacet.
        choice: Random, 0..1, decides between reflection and transmission.
    """
    to_view = wp.dot(view, half)
    mirrored = wp.normalize(2.0 * to_view * half - view)
    is_lost = wp.dot(normal, mirrored) <= 0.0
    found = mirrored
    if choice >= reflected_chance(bsdf, to_view):
        if bsdf.thin_walled:
            found = mirrored - 2.0 * wp.dot(normal, mirrored) * normal
        else:
            found = refract(-view, half, bending(bsdf.eta))
            is_lost = wp.dot(normal, found) >= 0.0
    if is_lost:
        return wp.vec3(0.0)
    return found


@wp.func
def glass_share(bsdf: Bsdf, cos_view: float) -> float:
    """Probability with which microfacets are sampled, and not the diffuse part."""
    mirrored = dielectric_share(bsdf.dielectric, cos_view, bsdf.eta)
    facets = (1.0 - bsdf.metallic) * mirrored + mean_of(bsdf.metal) + (1.0 - mirrored) * mean_of(bsdf.transmitted)
    diffuse = (1.0 - mirrored) * mean_of(bsdf.diffuse)
    if diffuse <= 0.0:
        return 1.0
    return facets / (facets + diffuse)
