"""BSDFs of rough, opaque surfaces without layers: the common case, in few instructions.

The functions return what ``bsdf_eval``, ``bsdf_pdf`` and ``sampled_direction`` return for such surfaces, to the bit.
Those called ``rough`` are for BSDF_PBR only and have no branches, so that compilers vectorise loops that call them.
"""

import warp as wp

from lumisplat.device.material.bsdf import (
    diffuse_factor,
    facet_mirrored,
    facets_or_cosine_pdf,
    phong_direction,
    reflected_by_facets,
    rough_mirrored_share,
    simple_eval,
    simple_pdf,
    simple_share,
    view_albedo,
)
from lumisplat.device.material.microfacets import ALPHA_GGX_MIN, HALF_MIN2
from lumisplat.device.math.color import mean_of
from lumisplat.device.math.directions import INV_PI, around
from lumisplat.device.math.lanes import picked
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf


@wp.func
def rough_diffuse(bsdf: Bsdf, cos_view: float, cos_light: float) -> wp.vec3:
    """Evaluates ``pbr_diffuse`` for rough, opaque surfaces only."""
    enters = 1.0 - rough_mirrored_share(bsdf.dielectric, bsdf.eta, bsdf.alpha, cos_light)
    leaves = 1.0 - rough_mirrored_share(bsdf.dielectric, bsdf.eta, bsdf.alpha, cos_view)
    factor = diffuse_factor(enters, leaves, bsdf.mean_mirrored)
    return wp.where(bsdf.dielectric <= 0.0, INV_PI, factor) * bsdf.diffuse


@wp.func
def rough_share(bsdf: Bsdf, cos_view: float) -> float:
    """Returns ``pbr_share`` for rough, opaque surfaces without multiple scattering."""
    specular = mean_of(view_albedo(bsdf, cos_view))
    mirrored = rough_mirrored_share(bsdf.dielectric, bsdf.eta, bsdf.alpha, cos_view)
    diffuse = (1.0 - mirrored) * mean_of(bsdf.diffuse)
    share = wp.where(diffuse <= 0.0, 1.0, specular / (specular + diffuse))
    return wp.where(bsdf.grazing <= 0.0, 0.0, share)


@wp.func
def rough_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Returns ``opaque_eval`` of BSDF_PBR."""
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    half = view + light
    facets = reflected_by_facets(bsdf, normal, view, light)
    is_flat = bsdf.grazing <= 0.0 or wp.dot(half, half) <= HALF_MIN2 or bsdf.alpha <= 0.0
    value = rough_diffuse(bsdf, cos_view, cos_light) + picked(is_flat, wp.vec3(0.0), facets)
    return picked(cos_view > 0.0 and cos_light > 0.0, value, wp.vec3(0.0))


@wp.func
def rough_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns ``opaque_pdf`` of BSDF_PBR."""
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    pdf = facets_or_cosine_pdf(bsdf, rough_share(bsdf, cos_view), INV_PI * cos_light, normal, view, light)
    return wp.where(cos_view > 0.0 and cos_light > 0.0, pdf, 0.0)


@wp.func
def opaque_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the BSDF of a rough, opaque surface without layers, per steradian, without the cosine."""
    if bsdf.model != BSDF_SIMPLE:
        return rough_eval(bsdf, normal, view, light)
    if wp.dot(normal, view) <= 0.0 or wp.dot(normal, light) <= 0.0:
        return wp.vec3(0.0)
    return simple_eval(bsdf, normal, view, light)


@wp.func
def opaque_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf, per steradian, with which ``opaque_direction`` samples ``light``."""
    if bsdf.model != BSDF_SIMPLE:
        return rough_pdf(bsdf, normal, view, light)
    if wp.dot(normal, view) <= 0.0 or wp.dot(normal, light) <= 0.0:
        return 0.0
    return simple_pdf(bsdf, normal, view, light)


@wp.func
def opaque_share(bsdf: Bsdf, cos_view: float) -> float:
    """Returns the probability with which a rough, opaque surface without layers samples its highlight."""
    if bsdf.model == BSDF_SIMPLE:
        return simple_share(bsdf)
    return rough_share(bsdf, cos_view)


@wp.func
def highlight_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Samples a unit direction of the highlight of a rough, opaque surface; zero: no direction was found."""
    if bsdf.model == BSDF_SIMPLE:
        return phong_direction(bsdf, normal, view, u)
    half = facet_mirrored(normal, view, wp.max(bsdf.alpha, ALPHA_GGX_MIN), u)
    return wp.normalize(2.0 * wp.dot(view, half) * half - view)


@wp.func
def opaque_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2, choice: float) -> wp.vec3:
    """Samples a unit direction of a rough, opaque surface without layers; zero: no direction was found."""
    if choice >= opaque_share(bsdf, wp.dot(normal, view)):
        return around(normal, wp.sqrt(1.0 - u[0]), wp.sqrt(u[0]), u[1])
    return highlight_direction(bsdf, normal, view, u)
