"""BSDFs: evaluation, sampling, and pdfs.

Directions are unit vectors away from the surface, ``view`` on the side of ``normal``. No light is reflected to
directions below the surface, but rough glass transmits light there. Both models, BSDF_SIMPLE and BSDF_PBR, are
reciprocal and conserve energy.

The equations are in docs/method/materials.md.
"""

import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.material.microfacets import (
    ALPHA_GGX_MIN,
    HALF_MIN2,
    dielectric_share,
    ggx_d,
    glass_direction,
    glass_eval,
    glass_pdf,
    glass_share,
    lost_share,
    mean_dielectric_share,
    mean_lost_share,
    mean_rising_share,
    rescattered_eval,
    rising_share,
    sample_ggx_vndf,
    smith_g1,
    transmits,
)
from lumisplat.device.math.color import is_black, mean_of
from lumisplat.device.math.directions import INV_PI, INV_TWO_PI, around
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf


@struct
class BsdfSample:
    """A direction sampled from a BSDF, with its weight and pdf."""

    direction: wp.vec3
    """Unit direction away from the surface."""
    weight: wp.vec3
    """BSDF times cosine over pdf; zero: no direction was found."""
    pdf: float
    """Pdf with which the BSDF samples the direction, per steradian; 0: no direction was found."""


# --- Diffuse lobe: cosine-weighted directions; from inside a body, only those without total reflection ---


@wp.func
def scattered_sine2(bsdf: Bsdf) -> float:
    """Returns ``sin^2`` of the largest angle from the normal at which light of the diffuse lobe leaves the surface.

    It is ``1 / eta^2`` on the denser side of a dielectric, where total internal reflection starts, else 1.
    """
    if bsdf.model == BSDF_SIMPLE or bsdf.dielectric <= 0.0 or bsdf.eta <= 1.0:
        return 1.0
    if bsdf.alpha > 0.0 and not transmits(bsdf):
        return 1.0
    return 1.0 / (bsdf.eta * bsdf.eta)


@wp.func
def diffuse_pdf(bsdf: Bsdf, cos_light: float) -> float:
    """Returns the pdf, per steradian, of ``diffuse_direction`` for a direction at cosine ``cos_light``."""
    sine2 = scattered_sine2(bsdf)
    if (1.0 - cos_light) * (1.0 + cos_light) > sine2:
        return 0.0
    return INV_PI * cos_light / sine2


@wp.func
def diffuse_direction(bsdf: Bsdf, normal: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Samples a cosine-weighted direction within the angle beyond which light is totally reflected."""
    sine2 = u[0] * scattered_sine2(bsdf)
    return around(normal, wp.sqrt(1.0 - sine2), wp.sqrt(sine2), u[1])


# --- Layers: clearcoat, and sheen below it (docs/method/materials.md#layers) ---
#
# Light that a layer reflects is missing below it: light there is multiplied by the transmittance of the layer for the
# view or for the light, whichever is less. Both layers are reciprocal and conserve energy.

HEAD_ON = wp.constant(wp.float32(COAT_HEAD_ON))

SINE2_MIN = wp.constant(wp.float32(1e-12))


@wp.func
def has_layers(bsdf: Bsdf) -> bool:
    """Returns whether a material has clearcoat or sheen."""
    return bsdf.coat > 0.0 or not is_black(bsdf.sheen)


@wp.func
def coat_share(coat: float, alpha: float, cosine: float) -> float:
    """Returns the albedo of a clearcoat of strength ``coat`` and GGX ``alpha``, seen at a cosine from the normal."""
    rising = rising_share(cosine, alpha)
    return coat * (HEAD_ON * (1.0 - lost_share(cosine, alpha) - rising) + rising)


@wp.func
def sheen_share(curve: wp.vec4, cosine: float) -> float:
    """Returns the fitted albedo of white sheen for a view at a cosine from the normal.

    Where the albedo is above 0.1, the fit is never below it. At grazing angles, both may exceed 1.
    """
    return wp.exp(curve[0] + cosine * (curve[1] + cosine * (curve[2] + cosine * curve[3])))


@wp.func
def left_by_coat(bsdf: Bsdf, cos_view: float, cos_light: float) -> float:
    """Returns the fraction of light that the clearcoat passes to sheen and base: 1 - its albedo.

    Of its albedos at the cosine of the view and at the cosine of the light, the larger one counts.
    """
    if bsdf.coat <= 0.0:
        return 1.0
    from_view = coat_share(bsdf.coat, bsdf.coat_alpha, cos_view)
    return 1.0 - wp.max(from_view, coat_share(bsdf.coat, bsdf.coat_alpha, cos_light))


@wp.func
def left_by_sheen(bsdf: Bsdf, cos_view: float, cos_light: float) -> float:
    """Returns the fraction of light that the sheen passes to the base below: 1 - its albedo.

    Of its albedos at the cosine of the view and at the cosine of the light, the larger one counts.
    """
    if is_black(bsdf.sheen):
        return 1.0
    largest = wp.max(sheen_share(bsdf.sheen_curve, cos_view), sheen_share(bsdf.sheen_curve, cos_light))
    return 1.0 - wp.max(bsdf.sheen) * wp.min(largest, 1.0)


@wp.func
def coat_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Evaluates the BSDF of the clearcoat above the horizon: a GGX highlight with F0 = 0.04."""
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
    """Returns the pdf of directions reflected at visible microfacets of the clearcoat, per steradian."""
    half = view + light
    if wp.dot(half, half) <= SINE2_MIN:
        return 0.0
    return 0.5 * ggx_d(normal, half, bsdf.coat_alpha) * smith_g1(wp.dot(normal, view), bsdf.coat_alpha)


@wp.func
def sheen_masking_exponent(x: float, alpha: float) -> float:
    """Returns the exponent L(x) of the fitted sheen masking function (Estevez and Kulla 2017) for a cosine x."""
    smooth = (1.0 - alpha) * (1.0 - alpha)
    a = 21.5473 + smooth * (25.3245 - 21.5473)
    b = 3.82987 + smooth * (3.32435 - 3.82987)
    c = 0.19823 + smooth * (0.16801 - 0.19823)
    d = -1.97760 + smooth * (1.97760 - 1.27393)
    e = -4.32054 + smooth * (4.32054 - 4.85967)
    return a / (1.0 + b * wp.pow(wp.max(x, 1e-6), c)) + d * x + e


@wp.func
def sheen_masking(cosine: float, alpha: float) -> float:
    """Returns Smith's Lambda of sheen by the fit of Estevez and Kulla (2017); masking and shadowing follow from it."""
    if cosine < 0.5:
        return wp.exp(sheen_masking_exponent(cosine, alpha))
    return wp.exp(2.0 * sheen_masking_exponent(0.5, alpha) - sheen_masking_exponent(1.0 - cosine, alpha))


@wp.func
def sheen_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the BSDF of the sheen above the horizon: upright fibres (Estevez and Kulla 2017).

    It is divided by the sheen's albedo where that exceeds 1, so that it conserves energy.
    """
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
    """Returns the probabilities of sampling the clearcoat and the sheen, in proportion to their albedos.

    With the remaining probability, the base is sampled; ``below`` is its approximate albedo.
    """
    coat = coat_share(bsdf.coat, bsdf.coat_alpha, cos_view)
    sheen = (1.0 - coat) * mean_of(bsdf.sheen) * wp.min(sheen_share(bsdf.sheen_curve, cos_view), 1.0)
    rest = left_by_coat(bsdf, cos_view, cos_view) * left_by_sheen(bsdf, cos_view, cos_view) * below
    total = wp.max(coat + sheen + rest, 1e-12)
    return wp.vec2(coat / total, sheen / total)


# --- The BSDF of a material ---

EXPONENT_MIN = wp.constant(wp.float32(-30.0))
"""The Phong highlight is 0 where its natural logarithm is below this value."""

# --- Simple model: a diffuse lobe and a Phong highlight ---


@wp.func
def simple_scale(bsdf: Bsdf) -> wp.vec3:
    """Returns ``1 / max(diffuse + specular, 1)`` per channel, which keeps the albedo of BSDF_SIMPLE at most 1."""
    total = bsdf.diffuse + bsdf.specular
    return wp.vec3(1.0 / wp.max(total[0], 1.0), 1.0 / wp.max(total[1], 1.0), 1.0 / wp.max(total[2], 1.0))


@wp.func
def highlight(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the Phong highlight: the cosine between ``light`` and the mirror direction of ``view``, to a power.

    The exponent is the shininess.
    """
    cosine = 2.0 * wp.dot(normal, view) * wp.dot(normal, light) - wp.dot(view, light)
    # Because log(x) <= x - 1, most directions need no power.
    if cosine <= 0.0 or bsdf.shininess * (cosine - 1.0) < EXPONENT_MIN:
        return 0.0
    return wp.exp(bsdf.shininess * wp.log(wp.min(cosine, 1.0)))


@wp.func
def simple_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates BSDF_SIMPLE (diffuse plus Phong), linear, per steradian, without the cosine, for light from above."""
    value = INV_PI * bsdf.diffuse
    if wp.max(bsdf.specular) > 0.0:
        value += INV_TWO_PI * (bsdf.shininess + 2.0) * highlight(bsdf, normal, view, light) * bsdf.specular
    if wp.max(bsdf.diffuse + bsdf.specular) > 1.0:
        value = wp.cw_mul(value, simple_scale(bsdf))
    return value


@wp.func
def simple_share(bsdf: Bsdf) -> float:
    """Returns the probability with which BSDF_SIMPLE samples its highlight instead of the diffuse lobe."""
    specular = mean_of(bsdf.specular)
    if specular <= 0.0:
        return 0.0
    return specular / (specular + mean_of(bsdf.diffuse))


# --- Metallic-roughness model ---


@wp.func
def reflectance(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the reflectance of a microfacet of BSDF_PBR for the cosine of incidence (Schlick 1994)."""
    return bsdf.specular + schlick_factor(cosine) * (wp.vec3(bsdf.grazing) - bsdf.specular)


@wp.func
def schlick_factor(cosine: float) -> float:
    """Returns ``(1 - cosine)^5``, by which the reflectance rises from normal to grazing incidence (Schlick 1994)."""
    x = wp.max(1.0 - cosine, 0.0)
    x2 = x * x
    return x2 * x2 * x


@wp.func
def view_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the albedo of the GGX highlight for a view at ``cosine`` from the normal, single scattering only."""
    rising = rising_share(cosine, bsdf.alpha)
    return (1.0 - lost_share(cosine, bsdf.alpha) - rising) * bsdf.specular + wp.vec3(rising * bsdf.grazing)


@wp.func
def head_on_share(dielectric: float, eta: float) -> float:
    """Returns a dielectric's reflectance at normal incidence: Fresnel's times the strength ``dielectric``."""
    ratio = (1.0 - eta) / (1.0 + eta)
    return dielectric * ratio * ratio


@wp.func
def mirrored_share(bsdf: Bsdf, cosine: float) -> float:
    """Returns the fraction of light arriving at a cosine that the dielectric reflects as highlight or mirror image."""
    if bsdf.alpha <= 0.0 or transmits(bsdf):
        return dielectric_share(bsdf.dielectric, cosine, bsdf.eta)
    return rough_mirrored_share(bsdf.dielectric, bsdf.eta, bsdf.alpha, cosine)


@wp.func
def rough_mirrored_share(dielectric: float, eta: float, alpha: float, cosine: float) -> float:
    """Returns ``mirrored_share`` of a rough, opaque surface."""
    rising = rising_share(cosine, alpha)
    head_on = head_on_share(dielectric, eta)
    return head_on * (1.0 - lost_share(cosine, alpha) - rising) + dielectric * rising


@wp.func
def mean_mirrored_share(dielectric: float, eta: float, alpha: float, fresnel_mean: float) -> float:
    """Returns the fraction of uniform hemispherical illumination that a dielectric reflects specularly.

    It is the mean of ``mirrored_share``. ``fresnel_mean`` is the mean of Fresnel's reflectance for a smooth surface.
    """
    if alpha <= 0.0:
        return mean_dielectric_share(dielectric, fresnel_mean, eta)
    rising = mean_rising_share(alpha)
    return head_on_share(dielectric, eta) * (1.0 - mean_lost_share(alpha) - rising) + dielectric * rising


@wp.func
def pbr_diffuse(bsdf: Bsdf, cos_view: float, cos_light: float) -> wp.vec3:
    """Evaluates the diffuse lobe of BSDF_PBR (Kelemen and Szirmay-Kalos 2001).

    It scatters light that is reflected specularly neither on entry nor on exit.
    """
    if bsdf.dielectric <= 0.0:
        return INV_PI * bsdf.diffuse
    enters = 1.0 - mirrored_share(bsdf, cos_light)
    leaves = 1.0 - mirrored_share(bsdf, cos_view)
    return diffuse_factor(enters, leaves, bsdf.mean_mirrored) * bsdf.diffuse


@wp.func
def diffuse_factor(enters: float, leaves: float, mean_mirrored: float) -> float:
    """Returns the diffuse lobe of BSDF_PBR for a white albedo.

    ``enters`` and ``leaves`` are the fractions of light that are not reflected specularly on entry and on exit.
    """
    return INV_PI * enters * leaves / wp.max(1.0 - mean_mirrored, 1e-6)


@wp.func
def facets_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the GGX highlight of BSDF_PBR, per steradian, without the cosine; light is above the horizon."""
    half = view + light
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0 or wp.dot(half, half) <= HALF_MIN2:
        return wp.vec3(0.0)
    return reflected_by_facets(bsdf, normal, view, light)


@wp.func
def reflected_by_facets(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Returns ``facets_eval`` where there are microfacets that reflect ``light`` to ``view``."""
    half = view + light
    alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    # Cook and Torrance's D G / (4 cos cos), whose cosines cancel with those of Smith's G.
    masks = smith_g1(wp.dot(normal, view), alpha) * smith_g1(wp.dot(normal, light), alpha)
    return (ggx_d(normal, half, alpha) * masks) * reflectance(bsdf, 0.5 * wp.sqrt(wp.dot(half, half)))


@wp.func
def pbr_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates BSDF_PBR without layers, linear, per steradian, without the cosine; light is above the horizon."""
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    value = wp.vec3(0.0)
    if wp.max(bsdf.diffuse) > 0.0:
        value = pbr_diffuse(bsdf, cos_view, cos_light)
    if transmits(bsdf):
        return value + glass_eval(bsdf, normal, view, light)
    if not is_black(bsdf.rescattered):
        value += rescattered_eval(bsdf.rescattered, cos_view, cos_light, bsdf.alpha)
    return value + facets_eval(bsdf, normal, view, light)


@wp.func
def pbr_share(bsdf: Bsdf, cos_view: float) -> float:
    """Returns the probability with which BSDF_PBR samples its highlight or, for rough glass, its microfacets.

    The probability is the approximate fraction that these contribute to the albedo; the diffuse lobe has the rest.
    """
    if transmits(bsdf):
        return glass_share(bsdf, cos_view)
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0:
        return 0.0
    specular = mean_of(view_albedo(bsdf, cos_view))
    diffuse = (1.0 - mirrored_share(bsdf, cos_view)) * mean_of(bsdf.diffuse)
    if not is_black(bsdf.rescattered):
        diffuse += lost_share(cos_view, bsdf.alpha) * mean_of(bsdf.rescattered)
    if diffuse <= 0.0:
        return 1.0
    return specular / (specular + diffuse)


# --- Both models, without layers ---


@wp.func
def base_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the BSDF without clearcoat and sheen, linear, per steradian, without the cosine."""
    if wp.dot(normal, view) <= 0.0:
        return wp.vec3(0.0)
    if wp.dot(normal, light) <= 0.0:
        if transmits(bsdf) and wp.dot(normal, light) < 0.0:
            return glass_eval(bsdf, normal, view, light)
        return wp.vec3(0.0)
    if bsdf.model == BSDF_SIMPLE:
        return simple_eval(bsdf, normal, view, light)
    return pbr_eval(bsdf, normal, view, light)


@wp.func
def simple_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf, per steradian, with which BSDF_SIMPLE samples ``light``; ``light`` must be above the horizon."""
    diffuse = INV_PI * wp.dot(normal, light)
    share = simple_share(bsdf)
    if share <= 0.0:
        return diffuse
    specular = INV_TWO_PI * (bsdf.shininess + 1.0) * highlight(bsdf, normal, view, light)
    return share * specular + (1.0 - share) * diffuse


@wp.func
def facets_or_cosine_pdf(
    bsdf: Bsdf, share: float, diffuse: float, normal: wp.vec3, view: wp.vec3, light: wp.vec3
) -> float:
    """Returns the pdf of ``light`` if visible microfacets are sampled with probability ``share``, else the cosine lobe.

    ``diffuse`` is the pdf of the diffuse lobe.
    """
    half = view + light
    alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    specular = 0.5 * ggx_d(normal, half, alpha) * smith_g1(wp.dot(normal, view), alpha)
    rest = (1.0 - share) * diffuse
    return wp.where(share <= 0.0 or wp.dot(half, half) <= HALF_MIN2, rest, share * specular + rest)


@wp.func
def pbr_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf, per steradian, with which BSDF_PBR without layers samples ``light`` above the horizon."""
    cos_view = wp.dot(normal, view)
    diffuse = diffuse_pdf(bsdf, wp.dot(normal, light))
    share = pbr_share(bsdf, cos_view)
    if transmits(bsdf):
        return share * glass_pdf(bsdf, normal, view, light) + (1.0 - share) * diffuse
    return facets_or_cosine_pdf(bsdf, share, diffuse, normal, view, light)


@wp.func
def base_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf, per steradian, with which the BSDF without clearcoat and sheen samples ``light``."""
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    if cos_view <= 0.0:
        return 0.0
    if cos_light <= 0.0:
        if cos_light < 0.0 and transmits(bsdf):
            return pbr_share(bsdf, cos_view) * glass_pdf(bsdf, normal, view, light)
        return 0.0
    if bsdf.model == BSDF_SIMPLE:
        return simple_pdf(bsdf, normal, view, light)
    return pbr_pdf(bsdf, normal, view, light)


@wp.func
def facet_mirrored(normal: wp.vec3, view: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Samples the normal of a GGX microfacet visible to ``view``, world space, unit; ``view`` reflects about it."""
    # The frame has x along the view direction projected onto the surface.
    cos_view = wp.dot(normal, view)
    along = view - cos_view * normal
    sine = wp.length(along)
    if sine > 1e-6:
        along = along / sine
    else:
        along = around(normal, 0.0, 1.0, 0.0)
    facet = sample_ggx_vndf(wp.vec3(sine, 0.0, cos_view), alpha, u)
    return facet[0] * along + facet[1] * wp.cross(normal, along) + facet[2] * normal


@wp.func
def phong_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2) -> wp.vec3:
    """Samples a unit direction of the highlight of BSDF_SIMPLE."""
    mirrored = 2.0 * wp.dot(normal, view) * normal - view
    cosine = wp.pow(1.0 - u[0], 1.0 / (bsdf.shininess + 1.0))
    sine = wp.sqrt(wp.max((1.0 - cosine) * (1.0 + cosine), 0.0))
    return around(wp.normalize(mirrored), cosine, sine, u[1])


@wp.func
def base_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2, choice: float) -> wp.vec3:
    """Samples a unit direction of the BSDF without clearcoat and sheen; zero: no direction was found."""
    cos_view = wp.dot(normal, view)
    share = float(0.0)
    if bsdf.model == BSDF_SIMPLE:
        share = simple_share(bsdf)
    else:
        share = pbr_share(bsdf, cos_view)
    if choice >= share:
        return diffuse_direction(bsdf, normal, u)
    if bsdf.model == BSDF_SIMPLE:
        return phong_direction(bsdf, normal, view, u)
    half = facet_mirrored(normal, view, wp.max(bsdf.alpha, ALPHA_GGX_MIN), u)
    if transmits(bsdf):
        return glass_direction(bsdf, normal, view, half, choice / share)
    return wp.normalize(2.0 * wp.dot(view, half) * half - view)


@wp.func
def base_albedo(bsdf: Bsdf, cos_view: float) -> float:
    """Estimates the albedo of the BSDF without clearcoat and sheen for a view at cosine ``cos_view``.

    The mirror reflection of smooth surfaces does not count, because rays trace it.
    """
    if bsdf.model == BSDF_SIMPLE:
        return mean_of(bsdf.diffuse) + mean_of(bsdf.specular)
    albedo = mean_of(bsdf.diffuse) + mean_of(bsdf.transmitted)
    if bsdf.alpha > 0.0:
        albedo += mean_of(view_albedo(bsdf, cos_view))
    return albedo


# --- With layers ---


@wp.func
def bsdf_eval(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the BSDF, per steradian, linear Rec.709: radiance towards ``view`` over irradiance from ``light``.

    The cosine is not included.
    """
    value = base_eval(bsdf, normal, view, light)
    cos_view = wp.dot(normal, view)
    if not has_layers(bsdf) or cos_view <= 0.0:
        return value
    cos_light = wp.dot(normal, light)
    below = left_by_coat(bsdf, cos_view, wp.abs(cos_light))
    value = below * left_by_sheen(bsdf, cos_view, wp.abs(cos_light)) * value
    if cos_light > 0.0:
        value += below * sheen_eval(bsdf, normal, view, light) + wp.vec3(coat_eval(bsdf, normal, view, light))
    return value


@wp.func
def bsdf_pdf(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> float:
    """Returns the pdf with which ``bsdf_sample`` samples the direction ``light``, per steradian.

    Its integral over all directions is 1 minus the probability that no direction is found: a reflection below the
    horizon, or a transmission above it.
    """
    pdf = base_pdf(bsdf, normal, view, light)
    cos_view = wp.dot(normal, view)
    if not has_layers(bsdf) or cos_view <= 0.0:
        return pdf
    shares = layer_shares(bsdf, cos_view, base_albedo(bsdf, cos_view))
    pdf *= wp.max(1.0 - shares[0] - shares[1], 0.0)
    cos_light = wp.dot(normal, light)
    if cos_light > 0.0:
        pdf += shares[0] * coat_pdf(bsdf, normal, view, light) + shares[1] * INV_PI * cos_light
    return pdf


@wp.func
def sampled_direction(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2, choice: float) -> wp.vec3:
    """Samples a direction by clearcoat, sheen or base, as ``choice`` selects; zero: no direction was found."""
    if not has_layers(bsdf):
        return base_direction(bsdf, normal, view, u, choice)
    cos_view = wp.dot(normal, view)
    shares = layer_shares(bsdf, cos_view, base_albedo(bsdf, cos_view))
    if choice < shares[0]:
        half = facet_mirrored(normal, view, bsdf.coat_alpha, u)
        return wp.normalize(2.0 * wp.dot(view, half) * half - view)
    if choice < shares[0] + shares[1]:
        return around(normal, wp.sqrt(1.0 - u[0]), wp.sqrt(u[0]), u[1])
    rest = 1.0 - shares[0] - shares[1]
    return base_direction(bsdf, normal, view, u, (choice - shares[0] - shares[1]) / wp.max(rest, 1e-12))


@wp.func
def bsdf_sample(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, u: wp.vec2, choice: float) -> BsdfSample:
    """Samples a direction of incident light in approximate proportion to the BSDF times the cosine.

    ``u`` is random, 0..1 each; ``choice``, random, 0..1, selects a lobe.
    """
    sample = BsdfSample()
    sample.direction = normal
    if wp.dot(normal, view) <= 0.0:
        return sample
    found = sampled_direction(bsdf, normal, view, u, choice)
    if is_black(found):
        return sample
    sample.direction = found
    pdf = bsdf_pdf(bsdf, normal, view, sample.direction)
    if pdf > 0.0:
        value = bsdf_eval(bsdf, normal, view, sample.direction)
        sample.weight = (wp.abs(wp.dot(normal, sample.direction)) / pdf) * value
        sample.pdf = pdf
    return sample


@wp.func
def diffuse_share(bsdf: Bsdf, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Returns the fraction, per channel, of the BSDF's value for ``view`` and ``light`` that the diffuse lobe adds.

    It is 0 for transmitted light.
    """
    share = wp.vec3(0.0)
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    value = bsdf_eval(bsdf, normal, view, light)
    if cos_view <= 0.0 or cos_light <= 0.0:
        return share
    diffuse = wp.vec3(0.0)
    if bsdf.model == BSDF_SIMPLE:
        diffuse = wp.cw_mul(INV_PI * bsdf.diffuse, simple_scale(bsdf))
    else:
        diffuse = pbr_diffuse(bsdf, cos_view, cos_light)
    if has_layers(bsdf):
        below = left_by_coat(bsdf, cos_view, cos_light) * left_by_sheen(bsdf, cos_view, cos_light)
        diffuse = below * diffuse
    for channel in range(3):
        if value[channel] > 0.0:
            share[channel] = wp.min(diffuse[channel] / value[channel], 1.0)
    return share
