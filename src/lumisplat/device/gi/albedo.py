"""What surfaces reflect of even light (docs/method/realtime.md#surfaces)."""

import warp as wp

from lumisplat.device.material.bsdf import mirrored_share, simple_scale, view_albedo
from lumisplat.device.structs.light import BSDF_SIMPLE, Bsdf

wp.set_module_options({"enable_backward": False})


@wp.func
def diffuse_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the diffuse part reflects to a view at that cosine."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.diffuse)
    if bsdf.dielectric <= 0.0:
        return bsdf.diffuse
    return (1.0 - mirrored_share(bsdf, cosine)) * bsdf.diffuse


@wp.func
def glossy_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the highlight reflects; a smooth surface, which has none, 0."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.specular)
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0:
        return wp.vec3(0.0)
    return view_albedo(bsdf, cosine)


@wp.func
def highlight_width(bsdf: Bsdf) -> float:
    """Width of the highlight, as alpha of GGX; that of Phong's exponent by Walter et al. 2007."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.sqrt(2.0 / (bsdf.shininess + 2.0))
    return bsdf.alpha
