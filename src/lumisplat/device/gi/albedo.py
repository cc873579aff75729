"""What surfaces reflect of even light (docs/method/realtime.md#surfaces)."""

import warp as wp

from lumisplat.device.material.bsdf import mirrored_share, simple_scale, view_albedo
from lumisplat.device.material.ggx import lost_share
from lumisplat.device.material.layers import coat_share, has_layers, left_by_coat, left_by_sheen, sheen_share
from lumisplat.device.material.rough_glass import transmits
from lumisplat.device.structs.light import BSDF_SIMPLE, Bsdf

wp.set_module_options({"enable_backward": False})

MEAN_COSINE = wp.constant(wp.float32(2.0 / 3.0))
"""Of even light, weighted by the cosine."""


@wp.func
def left_by_layers(bsdf: Bsdf, cosine: float) -> float:
    """Share of even light that layers leave to what is below, as if all of it came at its mean cosine."""
    if not has_layers(bsdf):
        return 1.0
    return left_by_coat(bsdf, cosine, MEAN_COSINE) * left_by_sheen(bsdf, cosine, MEAN_COSINE)


@wp.func
def diffuse_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the diffuse part reflects to a view at that cosine."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.diffuse)
    if bsdf.dielectric <= 0.0:
        return left_by_layers(bsdf, cosine) * bsdf.diffuse
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.diffuse


@wp.func
def base_highlight(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the highlight below layers reflects; a smooth surface, which has none, 0."""
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0:
        return wp.vec3(0.0)
    return view_albedo(bsdf, cosine) + lost_share(cosine, bsdf.alpha) * bsdf.rescattered


@wp.func
def glossy_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that all but the diffuse part reflects, except what smooth surfaces mirror."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.specular)
    albedo = base_highlight(bsdf, cosine)
    if not has_layers(bsdf):
        return albedo
    fibres = wp.min(sheen_share(bsdf.sheen_curve, cosine), 1.0) * bsdf.sheen
    albedo = left_by_layers(bsdf, cosine) * albedo + left_by_coat(bsdf, cosine, MEAN_COSINE) * fibres
    return albedo + wp.vec3(coat_share(bsdf.coat, bsdf.coat_alpha, cosine))


@wp.func
def transmitted_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky behind a rough surface that comes through to a view."""
    if bsdf.model == BSDF_SIMPLE or not transmits(bsdf):
        return wp.vec3(0.0)
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.transmitted


@wp.func
def highlight_width(bsdf: Bsdf) -> float:
    """Width of the highlight, as alpha of GGX; that of Phong's exponent by Walter et al. 2007."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.sqrt(2.0 / (bsdf.shininess + 2.0))
    return bsdf.alpha


@wp.func
def matte_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of light from all around that a surface sends to a view, by reflection or through it, at most 1."""
    albedo = diffuse_albedo(bsdf, cosine) + glossy_albedo(bsdf, cosine) + transmitted_albedo(bsdf, cosine)
    return wp.min(albedo, wp.vec3(1.0))
