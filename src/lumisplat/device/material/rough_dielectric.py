"""Reflection by a rough dielectric of ior 1.5, whose two parts are a number each.

It is what ``pbr_eval`` is without metal, layers and transmission (docs/method/materials.md#metallic-roughness).
"""

import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.material.ggx import (
    ggx_d,
    lost_share,
    mean_lost_share,
    mean_rising_share,
    rising_share,
    smith_g1,
)
from lumisplat.device.math.directions import INV_PI
from lumisplat.device.structs.training import DirectionalLight

wp.set_module_options({"enable_backward": False})

HEAD_ON = wp.constant(wp.float32(COAT_HEAD_ON))


@wp.func
def mirrored(cosine: float, alpha: float) -> float:
    """Share of light from that cosine which the highlight takes."""
    rising = rising_share(cosine, alpha)
    return HEAD_ON * (1.0 - lost_share(cosine, alpha) - rising) + rising


@wp.func
def diffuse_factor(cos_view: float, cos_light: float, alpha: float) -> float:
    """BSDF of the diffuse part over the base colour."""
    rising = mean_rising_share(alpha)
    mean = HEAD_ON * (1.0 - mean_lost_share(alpha) - rising) + rising
    return INV_PI * (1.0 - mirrored(cos_light, alpha)) * (1.0 - mirrored(cos_view, alpha)) / (1.0 - mean)


@wp.func
def highlight_factor(normal: wp.vec3, view: wp.vec3, light: wp.vec3, alpha: float) -> float:
    """BSDF of the highlight, above the horizon; it has no colour."""
    half = view + light
    x = wp.max(1.0 - 0.5 * wp.length(half), 0.0)
    fresnel = HEAD_ON + (1.0 - HEAD_ON) * x * x * x * x * x
    masks = smith_g1(wp.dot(normal, view), alpha) * smith_g1(wp.dot(normal, light), alpha)
    return fresnel * ggx_d(normal, half, alpha) * masks


@wp.func
def reflected_dot(
    normal: wp.vec3,
    roughness: float,
    view: wp.vec3,
    light: wp.vec3,
    spread: float,
    by_diffuse: float,
    by_highlight: float,
) -> wp.float32:
    """Both parts times the cosine of the light, weighted by the derivatives of a loss by them, above the horizon."""
    alpha = roughness * roughness
    cos_light = wp.dot(normal, light)
    diffuse = diffuse_factor(wp.dot(normal, view), cos_light, alpha)
    highlight = highlight_factor(normal, view, light, wp.sqrt(alpha * alpha + spread))
    return cos_light * (by_diffuse * diffuse + by_highlight * highlight)


@wp.func
def light_on(light: DirectionalLight, i: int, k: int) -> wp.vec3:
    """Radiance that reaches Gaussian ``i`` from direction ``k``."""
    return light.open[i, k] * light.sky[k] + light.seen[i, k]
