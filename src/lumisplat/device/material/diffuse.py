"""Directions of the diffuse part: by the cosine, and from inside a body only those in which it lets light through.

The equations are in docs/method/materials.md#metallic-roughness.
"""

import warp as wp

from lumisplat.device.material.rough_glass import transmits
from lumisplat.device.math.directions import INV_PI, around
from lumisplat.device.structs.light import BSDF_SIMPLE, Bsdf

wp.set_module_options({"enable_backward": False})


@wp.func
def scattered_sine2(bsdf: Bsdf) -> float:
    """Squared sine of the widest angle at which light comes by the diffuse part: beyond it, all is mirrored."""
    if bsdf.model == BSDF_SIMPLE or bsdf.dielectric <= 0.0 or bsdf.eta <= 1.0:
        return 1.0
    if bsdf.alpha > 0.0 and not transmits(bsdf):
        return 1.0
    return 1.0 / (bsdf.eta * bsdf.eta)


@wp.func
def diffuse_pdf(bsdf: Bsdf, cos_light: float) -> float:
    """Density with which ``diffuse_direction`` samples a direction of that cosine, per steradian."""
    sine2 = scattered_sine2(bsdf)
    if (1.0 - cos_light) * (1.0 + cos_light) > sine2:
        return 0.0
    return INV_PI * cos_light / sine2


@wp.func
def diffuse_direction(bsdf: Bsdf, normal: wp.vec3, u: wp.vec2) -> wp.vec3:
    """A direction by its cosine, from where light comes by the diffuse part."""
    sine2 = u[0] * scattered_sine2(bsdf)
    return around(normal, wp.sqrt(1.0 - sine2), wp.sqrt(sine2), u[1])
