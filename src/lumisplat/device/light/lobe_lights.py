"""Lights in the highlights of surfaces: which light is chosen, and samples from lobe and light combined.

Real-time rendering takes one light sample per pixel. In a narrow highlight, a light is important if it lies there, and
a light that fills the highlight is better sampled by the highlight (docs/method/realtime.md#direct).
"""

import warp as wp

from lumisplat.constants import COAT_HEAD_ON
from lumisplat.device.light.emitters import (
    NEARER,
    area_pdf,
    candidates_on,
    point_above,
    radiance_of_emitter,
)
from lumisplat.device.light.light import (
    LIGHT_DIRECTIONAL,
    LIGHT_ENVIRONMENT,
    LIGHT_POINT,
    LIGHT_SPOT,
    cone,
    flat_area,
    is_flat,
    light_crossing,
    towards_flat,
    window,
)
from lumisplat.device.material.bsdf import (
    bsdf_eval,
    coat_eval,
    has_layers,
    left_by_coat,
    left_by_sheen,
    reflectance,
    view_albedo,
)
from lumisplat.device.material.microfacets import ALPHA_GGX_MIN, HALF_MIN2, ggx_d, smith_g1, transmits
from lumisplat.device.math.color import mean_of
from lumisplat.device.math.directions import INV_PI, PI, TWO_PI
from lumisplat.device.structs import struct
from lumisplat.device.structs.shading import (
    BSDF_SIMPLE,
    Bsdf,
    Interaction,
    LightCrossing,
    LightData,
    ShadingScene,
)

LOBE_CHANCE_MAX = 0.9
"""Largest probability with which the highlight of a metal samples the chosen light."""

LOBE_CHANCE_LEAST = 0.2
"""Probability with which a narrow highlight samples the chosen light although most light is scattered diffusely."""

LOBE_CHANCE_MIN = 0.05
"""Below this probability, highlights do not sample the light: it is smaller than they are wide."""

LOBE_REST = 0.1
"""Importance of a light outside of a highlight, as a fraction of that for a diffuse surface of the same albedo."""

LOBE_GAIN_MAX = 16.0
"""Largest importance of a light in a highlight, relative to that for a diffuse surface of the whole albedo.

Without it, other lights would hardly be chosen in highlights, and their diffuse light would be noise."""

EMITTERS_CROSSED = 64
"""Largest number of emissive triangles of a scene that highlights sample; each sample tests all."""

FOOTPRINT_LEAST = 0.01
"""Footprints below this fraction of the squared GGX alpha are neglected."""

FOOTPRINT_MIN = wp.constant(wp.float32(FOOTPRINT_LEAST))
CHANCE_MAX = wp.constant(wp.float32(LOBE_CHANCE_MAX))
CHANCE_LEAST = wp.constant(wp.float32(LOBE_CHANCE_LEAST))
CHANCE_MIN = wp.constant(wp.float32(LOBE_CHANCE_MIN))
REST = wp.constant(wp.float32(LOBE_REST))
GAIN_MAX = wp.constant(wp.float32(LOBE_GAIN_MAX))
CROSSED_MAX = wp.constant(EMITTERS_CROSSED)
COAT = wp.constant(wp.float32(COAT_HEAD_ON))
LIFTS = wp.constant(wp.float32(4.0))
"""Distance of a surface from an emissive triangle up to which it lies on the triangle, in lifts of `point_above`."""
TINY = wp.constant(wp.float32(1e-30))


# --- Highlights ---


@wp.func
def widened(bsdf: Bsdf, alpha2: float) -> Bsdf:
    """Returns the BSDF with the squared GGX alphas of its highlight and clearcoat raised by ``alpha2``.

    Smooth surfaces, whose reflection is traced, remain smooth; a Phong highlight gets the equivalent exponent.
    """
    wide = bsdf
    if bsdf.model == BSDF_SIMPLE:
        wide.shininess = wp.min(bsdf.shininess, 2.0 / (2.0 / (bsdf.shininess + 2.0) + alpha2) - 2.0)
        wide.shininess = wp.max(wide.shininess, 0.0)
        return wide
    if bsdf.alpha > 0.0:
        wide.alpha = wp.min(wp.sqrt(bsdf.alpha * bsdf.alpha + alpha2), wp.max(bsdf.alpha, 1.0))
    if bsdf.coat > 0.0:
        wide.coat_alpha = wp.min(wp.sqrt(bsdf.coat_alpha * bsdf.coat_alpha + alpha2), wp.max(bsdf.coat_alpha, 1.0))
    return wide


@wp.func
def facets_in_pixel(normal: wp.vec3, half: wp.vec3, alpha: float, footprint: float) -> float:
    """Returns GGX's D as a pixel sees it whose normals turn by a normal distribution within it.

    ``footprint`` is the squared GGX alpha of the normals in the pixel. In the space of slopes m, D is a Gaussian for
    what the footprint blurs, and the tail of GGX beyond m0; both together are normalized for any footprint:

    ``(1 - t)^2 exp(-m^2 / b) / (pi b) + alpha^2 / (pi (alpha^2 + max(m, m0)^2)^2)``
    with ``m0^2 = 2 footprint``, ``b = footprint + alpha^2 / 2`` and ``t = alpha^2 / (alpha^2 + m0^2)``.
    """
    along = wp.dot(normal, half)
    across = wp.cross(normal, half)
    cosine2 = along * along
    if along <= 0.0 or cosine2 <= 1e-6 * wp.dot(half, half):
        return 0.0
    slope2 = wp.dot(across, across) / cosine2
    cosine2 = cosine2 / wp.dot(half, half)
    alpha2 = alpha * alpha
    inner2 = 2.0 * footprint
    blurred = inner2 / (alpha2 + inner2)  # 1 - t
    width2 = footprint + 0.5 * alpha2
    spread = alpha2 + wp.max(slope2, inner2)
    core = blurred * blurred * wp.exp(-wp.min(slope2 / width2, 80.0)) / width2
    return INV_PI * (core + alpha2 / (spread * spread)) / (cosine2 * cosine2)


@wp.func
def eval_in_pixel(bsdf: Bsdf, footprint: float, normal: wp.vec3, view: wp.vec3, light: wp.vec3) -> wp.vec3:
    """Evaluates the BSDF as ``bsdf_eval`` does, its highlight and clearcoat averaged over the normals in a pixel."""
    if bsdf.model == BSDF_SIMPLE:
        return bsdf_eval(widened(bsdf, footprint), normal, view, light)
    value = bsdf_eval(bsdf, normal, view, light)
    half = view + light
    cos_view = wp.dot(normal, view)
    cos_light = wp.dot(normal, light)
    if footprint <= 0.0 or cos_view <= 0.0 or cos_light <= 0.0 or transmits(bsdf) or wp.dot(half, half) <= HALF_MIN2:
        return value
    if bsdf.alpha > 0.0 and bsdf.grazing > 0.0:
        alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
        more = facets_in_pixel(normal, half, alpha, footprint) - ggx_d(normal, half, alpha)
        more *= smith_g1(cos_view, alpha) * smith_g1(cos_light, alpha)
        if has_layers(bsdf):
            more *= left_by_coat(bsdf, cos_view, cos_light) * left_by_sheen(bsdf, cos_view, cos_light)
        value += more * reflectance(bsdf, 0.5 * wp.sqrt(wp.dot(half, half)))
    if bsdf.coat > 0.0:
        alpha = bsdf.coat_alpha
        ratio = facets_in_pixel(normal, half, alpha, footprint) / ggx_d(normal, half, alpha)
        value += wp.vec3((ratio - 1.0) * coat_eval(bsdf, normal, view, light))
    return wp.max(value, wp.vec3(0.0))


@struct
class Lobe:
    """Describes a surface's highlight, as far as the choice and the sampling of lights depend on it."""

    specular: float
    """Specular albedo, of highlight and clearcoat, mean over channels; 0: there is no highlight that samples lights."""
    diffuse: float
    """Albedo of the diffuse lobe, mean over channels."""
    alpha: float
    """GGX alpha of the highlight or, if that is narrower, of the clearcoat."""


@wp.func
def lobe_at(interaction: Interaction) -> Lobe:
    """Returns the highlight of an interaction; none on smooth surfaces without clearcoat, and on rough glass."""
    lobe = Lobe()
    bsdf = interaction.bsdf
    if bsdf.model == BSDF_SIMPLE:
        lobe.alpha = wp.sqrt(2.0 / (bsdf.shininess + 2.0))
        lobe.specular = mean_of(bsdf.specular)
        lobe.diffuse = mean_of(bsdf.diffuse)
        return lobe
    if transmits(bsdf) or interaction.shadow_catcher:
        return lobe
    cosine = wp.dot(interaction.normal, interaction.wo)
    lobe.diffuse = mean_of(bsdf.diffuse)
    lobe.alpha = 1.0
    if bsdf.alpha > 0.0 and bsdf.grazing > 0.0 and cosine > 0.0:
        lobe.specular = mean_of(view_albedo(bsdf, cosine))
        lobe.alpha = wp.max(bsdf.alpha, ALPHA_GGX_MIN)
    if bsdf.coat > 0.0:
        lobe.specular += COAT * bsdf.coat
        lobe.alpha = wp.min(lobe.alpha, bsdf.coat_alpha)
    return lobe


@wp.func
def relevant_footprint(footprint: float, interaction: Interaction) -> float:
    """Returns the footprint, or 0 if it widens the highlight of an interaction by less than half a percent."""
    lobe = lobe_at(interaction)
    if lobe.specular <= 0.0 or footprint < FOOTPRINT_MIN * lobe.alpha * lobe.alpha:
        return 0.0
    return footprint


# --- Size of lights ---


@wp.func
def angular_radius(number: int, position: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """Returns the approximate sine of half the angle that a light covers at a point; 0: a point-like light.

    Light ``number`` must not be the environment; the number of lights stands for the emissive triangles.
    """
    if number == scene[0].settings[0].light_count:
        away = scene[0].emitters.center - position
        return scene[0].emitters.radius / wp.sqrt(wp.max(wp.dot(away, away), TINY))
    light = scene[0].lights[number]
    if scene[0].settings[0].soft == 0:
        return 0.0
    if light.kind == LIGHT_DIRECTIONAL:
        return wp.sin(light.radius)
    away = light.position - position
    distance = wp.sqrt(wp.max(wp.dot(away, away), TINY))
    if is_flat(light):
        cosine = wp.max(-wp.dot(away, light.direction) / distance, 0.0)
        return wp.sqrt(INV_PI * cosine * flat_area(light)) / distance
    if light.kind == LIGHT_POINT or light.kind == LIGHT_SPOT:  # noqa: PLR1714
        return light.radius / distance
    return 0.0


# --- Choice of a light ---


@wp.func
def towards_sphere(offset: wp.vec3, radius: float, mirrored: wp.vec3) -> wp.vec3:
    """Returns the vector to the point of a sphere that is nearest to a ray along ``mirrored``, unit, from the origin.

    ``offset`` is the centre of the sphere.
    """
    beside = wp.max(wp.dot(offset, mirrored), 0.0) * mirrored - offset
    return offset + wp.min(1.0, radius / wp.max(wp.length(beside), TINY)) * beside


@wp.func
def towards_highlight(number: int, position: wp.vec3, mirrored: wp.vec3, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the vector from ``position`` to the point of light ``number`` nearest to the direction ``mirrored``.

    Karis (2013) calls it the representative point of an area light. The light is not the environment.
    """
    if number == scene[0].settings[0].light_count:
        return towards_sphere(scene[0].emitters.center - position, scene[0].emitters.radius, mirrored)
    light = scene[0].lights[number]
    radius = wp.where(scene[0].settings[0].soft != 0, light.radius, 0.0)
    if light.kind == LIGHT_DIRECTIONAL:
        return towards_sphere(-light.direction, wp.sin(radius), mirrored)
    if is_flat(light) and scene[0].settings[0].soft != 0:
        return towards_flat(light, light.position - position, mirrored)
    if light.kind == LIGHT_POINT or light.kind == LIGHT_SPOT:  # noqa: PLR1714
        return towards_sphere(light.position - position, radius, mirrored)
    return light.position - position


@wp.func
def lobe_gain(number: int, interaction: Interaction, lobe: Lobe, scene: wp.array[ShadingScene]) -> float:
    """Returns how much more of light ``number`` a highlight reflects than a diffuse surface of the same albedo.

    The highlight counts as widened by the extent of the light, which must not be the environment.
    """
    normal = interaction.normal
    view = interaction.wo
    mirrored = 2.0 * wp.dot(normal, view) * normal - view
    towards = wp.normalize(towards_highlight(number, interaction.position, mirrored, scene))
    half = view + towards
    if wp.dot(half, half) <= 1e-6:
        return 0.0
    radius = 0.5 * wp.min(angular_radius(number, interaction.position, scene), 1.0)
    alpha = wp.min(wp.sqrt(lobe.alpha * lobe.alpha + radius * radius), 1.0)
    cos_view = wp.max(wp.dot(normal, view), 0.05)
    cos_light = wp.max(wp.dot(normal, towards), 0.05)
    return PI * ggx_d(normal, half, alpha) * smith_g1(cos_view, alpha) * smith_g1(cos_light, alpha)


@wp.func
def lobe_importance(
    number: int, importance: float, interaction: Interaction, lobe: Lobe, scene: wp.array[ShadingScene]
) -> float:
    """Returns the importance of light ``number`` at a surface with a highlight; 0 only where ``importance`` is.

    ``importance`` estimates the irradiance by the light. It is multiplied by the albedo, in the highlight also by its
    gain.
    """
    if not importance > 0.0:
        return 0.0
    if number < scene[0].settings[0].light_count:
        if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
            return importance * (lobe.diffuse + lobe.specular)
    gained = lobe.specular * lobe_gain(number, interaction, lobe, scene)
    gained = wp.min(gained, GAIN_MAX * (lobe.diffuse + lobe.specular))
    return importance * (lobe.diffuse + REST * lobe.specular + gained)


# --- Samples of the chosen light by the highlight ---


@wp.func
def emitter_crossing(k: int, origin: wp.vec3, direction: wp.vec3, scene: wp.array[ShadingScene]) -> LightCrossing:
    """Intersects a ray with emissive triangle ``k``; the pdf, of candidate points, is 0 if the ray misses it.

    A ray misses the triangle that it starts on, whatever the rounding of its origin. The distance ends shortly before
    the triangle, as that of light samples does.
    """
    crossing = LightCrossing()
    triangle = scene[0].emitters.triangles[k]
    slope = wp.dot(triangle.across, direction)
    offset = triangle.corner - origin
    away = wp.dot(offset, triangle.across)
    if slope == 0.0 or wp.abs(away) <= LIFTS * triangle.lift * wp.dot(triangle.across, triangle.across):
        return crossing
    t = away / slope
    side = wp.cross(direction, offset)
    u = -wp.dot(triangle.edge2, side) / slope
    v = wp.dot(triangle.edge1, side) / slope
    if t > 0.0 and u >= 0.0 and v >= 0.0 and u + v <= 1.0:
        corners = wp.vec3(1.0 - u - v, u, v)
        crossing.radiance = radiance_of_emitter(k, corners, direction, scene)
        crossing.pdf = area_pdf(candidates_on(k, scene), triangle.across, direction, t * t)
        crossing.t = NEARER * wp.dot(point_above(triangle, corners, origin) - origin, direction)
    return crossing


@wp.func
def sun_crossing(light: LightData, direction: wp.vec3) -> LightCrossing:
    """Returns radiance and pdf of a directional light with an angular radius in a direction; the pdf is 0 outside."""
    crossing = LightCrossing()
    crossing.t = wp.inf
    off = direction + light.direction
    sine = wp.sin(0.5 * light.radius)
    edge = 2.0 * sine * sine
    if 0.5 * wp.dot(off, off) <= edge:
        crossing.pdf = 1.0 / wp.max(TWO_PI * edge, TINY)
        crossing.radiance = (2.0 / (2.0 - edge) * crossing.pdf) * light.power
    return crossing


@wp.func
def crossing_of(number: int, origin: wp.vec3, direction: wp.vec3, scene: wp.array[ShadingScene]) -> LightCrossing:
    """Intersects a ray with light ``number``, which has an extent; the pdf is 0 if the ray misses it."""
    light = scene[0].lights[number]
    if light.kind == LIGHT_DIRECTIONAL:
        return sun_crossing(light, direction)
    crossing = light_crossing(light, origin, direction)
    if not is_flat(light):
        away = light.position - origin
        share = window(light, wp.dot(away, away))
        if light.kind == LIGHT_SPOT:
            share *= cone(light, wp.normalize(away))
        crossing.radiance = share * crossing.radiance
    return crossing


@wp.func
def most_by_lobe(lobe: Lobe) -> float:
    """Returns the probability with which a highlight samples a light that fills it."""
    return wp.max(CHANCE_MAX * lobe.specular / wp.max(lobe.specular + lobe.diffuse, TINY), CHANCE_LEAST)


@wp.func
def lobe_chance(number: int, interaction: Interaction, scene: wp.array[ShadingScene]) -> float:
    """Returns the probability with which the highlight, not light ``number``, samples the direction to the light.

    It is in proportion to the fraction of the highlight that the light approximately fills, and 0 if that is small.
    The light must be neither the environment nor the emissive triangles.
    """
    lobe = lobe_at(interaction)
    if lobe.specular <= 0.0:
        return 0.0
    radius = angular_radius(number, interaction.position, scene)
    if radius >= 1.0 and not is_flat(scene[0].lights[number]):
        return 0.0  # inside of a sphere, which is then a point
    radius = wp.min(radius, 1.0)
    chance = most_by_lobe(lobe) * wp.min(radius * radius * lobe_gain(number, interaction, lobe, scene), 1.0)
    return wp.where(chance < CHANCE_MIN, 0.0, chance)
