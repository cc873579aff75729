"""Layers on a surface: clearcoat, and sheen below it (KHR_materials_clearcoat, KHR_materials_sheen).

What a layer reflects is missing below it: light there is multiplied by what the layer leaves of that from the view or
from the light, whichever is less. Both layers are reciprocal, and no more light leaves than arrives.

The equations are in docs/method/materials.md#layers.
"""

import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.material.ggx import ggx_d, lost_share, rising_share, smith_g1
from lumisplat.device.math.color import is_black, mean_of
from lumisplat.device.math.directions import INV_TWO_PI
from lumisplat.device.structs.light import Bsdf

wp.set_module_options({"enable_backward": False})

HEAD_ON = wp.constant(wp.float32(COAT_HEAD_ON))
SINE2_MIN = wp.constant(wp.float32(1e-12))


@wp.func
def has_layers(bsdf: Bsdf) -> bool:
    """Whether there is clearcoat or sheen."""
    return bsdf.coat > 0.0 or not is_black(bsdf.sheen)


@wp.func
def coat_share(coat: float, alpha: float, cosine: float) -> float:
    """Share of a white sky that clearcoat reflects to a view at that cosine."""
    rising = rising_share(cosine, alpha)
    return coat * (HEAD_ON * (1.0 - lost_share(cosine, alpha) - rising) + rising)


@wp.func
def sheen_share(curve: wp.vec4, cosine: float) -> float:
    """The same of white sheen, at least; above 1 where that is."""
    return wp.exp(curve[0] + cosine * (curve[1] + cosine * (curve[2] + cosine * curve[3])))


@wp.func
def left_by_coat(bsdf: Bsdf, cos_view: float, cos_light: float) -> float:
    """Share of light that clearcoat leaves to what is below."""
    if bsdf.coat <= 0.0:
        return 1.0
    from_view = coat_share(bsdf.coat, bsdf.coat_alpha, cos_view)
    return 1.0 - wp.max(from_view, coat_share(bsdf.coat, bsdf.coat_alpha, cos_light))


@wp.func
def left_by_sheen(bsdf: Bsdf, cos_view: float, cos_light: float) -> float:
    """Share of light that sheen leaves to what is below."""
    if is_black(bsdf.sheen):
        return 1.0
    largest = wp.max(sheen_share(bsdf.sheen_curve, cos_view), sheen_share(bsdf.sheen_curve, cos_light))
    return 1.0 - wp.max(bsdf.sheen) * wp.min(largest, 1.0)


@wp.func
def coat_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Reflection by clearcoat, above the horizon: as a highlight of F0 = 0.04."""
    half = view + light
    length2 = wp.dot(half, half)
    if bsdf.coat <= 0.0 or length2 <= SINE2_MIN:
        return 0.0
    x = wp.max(1.0 - 0.5 * wp.sqrt(length2), 0.0)
    fresnel = HEAD_ON + (1.0 - HEAD_ON) * x * x * x * x * x
    masks = smith_g1(wp.dot(normal, view), bsdf.coat_alpha) * smith_g1(wp.dot(normal, light), bsdf.coat_alpha)
    return bsdf.coat * fresnel * ggx_d(normal, half, bsdf.coat_alpha) * masks


@wp.func
def coat_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Density of directions mirrored by visible facets of the clearcoat, per steradian."""
    half = view + light
    if wp.dot(half, half) <= SINE2_MIN:
        return 0.0
    return 0.5 * ggx_d(normal, half, bsdf.coat_alpha) * smith_g1(wp.dot(normal, view), bsdf.coat_alpha)


@wp.func
def sheen_masking_exponent(x: float, alpha: float) -> float:
    """Exponent of the fit of masking (Estevez and Kulla 2017)."""
    smooth = (1.0 - alpha) * (1.0 - alpha)
    a = 21.5473 + smooth * (25.3245 - 21.5473)
    b = 3.82987 + smooth * (3.32435 - 3.82987)
    c = 0.19823 + smooth * (0.16801 - 0.19823)
    d = -1.97760 + smooth * (1.97760 - 1.27393)
    e = -4.32054 + smooth * (4.32054 - 4.85967)
    return a / (1.0 + b * wp.pow(wp.max(x, 1e-6), c)) + d * x + e


@wp.func
def sheen_masking(cosine: float, alpha: float) -> float:
    """Lambda of the fit."""
    if cosine < 0.5:
        return wp.exp(sheen_masking_exponent(cosine, alpha))
    return wp.exp(2.0 * sheen_masking_exponent(0.5, alpha) - sheen_masking_exponent(1.0 - cosine, alpha))


@wp.func
def sheen_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Reflection by fibres that stand upright, above the horizon (Estevez and Kulla 2017), at most what arrives."""
    half = view + light
    length2 = wp.dot(half, half)
    if is_black(bsdf.sheen) or length2 <= SINE2_MIN:
        return wp.vec3(0.0)
    across = wp.cross(normal, half)
    sine2 = wp.max(wp.dot(across, across) / length2, SINE2_MIN)
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    fibres = INV_TWO_PI * (2.0 + 1.0 / bsdf.sheen_alpha) * wp.exp(0.5 / bsdf.sheen_alpha * wp.log(sine2))
    masks = 1.0 + sheen_masking(cos_view, bsdf.sheen_alpha) + sheen_masking(cos_light, bsdf.sheen_alpha)
    most = wp.max(sheen_share(bsdf.sheen_curve, cos_view), sheen_share(bsdf.sheen_curve, cos_light))
    return (fibres / (4.0 * cos_view * cos_light * masks * wp.max(most, 1.0))) * bsdf.sheen


@wp.func
def layer_shares(bsdf: Bsdf, cos_view: float, below: float) -> wp.vec2:
    """Probabilities with which clearcoat and sheen are sampled; ``below``: about the albedo of what is below them."""
    coat = coat_share(bsdf.coat, bsdf.coat_alpha, cos_view)
    sheen = (1.0 - coat) * mean_of(bsdf.sheen) * wp.min(sheen_share(bsdf.sheen_curve, cos_view), 1.0)
    rest = left_by_coat(bsdf, cos_view, cos_view) * left_by_sheen(bsdf, cos_view, cos_view) * below
    total = wp.max(coat + sheen + rest, 1e-12)
    return wp.vec2(coat / total, sheen / total)
