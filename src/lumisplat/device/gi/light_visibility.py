"""Visibility of lights at pixels: which fraction of each light's unshadowed irradiance arrived in earlier frames.

Unshadowed light of lamps and suns is computed anew in each frame; only its visibility is remembered
(docs/method/realtime.md#visibility).
"""

import warp as wp

from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.surfaces import MovedBox, PixelLight
from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    casts_shadow,
    choice_count,
    contribution_of,
    irradiance_of,
    light_importance,
    sample_by_lobe,
    start_chosen_ray,
    weight_beside_lobe,
)
from lumisplat.device.light.light import LIGHT_DIRECTIONAL, LIGHT_HEADLIGHT, LIGHT_POINT, LIGHT_SPOT, sample_light
from lumisplat.device.light.lobe_lights import Lobe, angular_radius, lobe_at, lobe_chance, lobe_importance
from lumisplat.device.light.shadow_rays import reach_of
from lumisplat.device.material.microfacets import transmits
from lumisplat.device.math.color import is_black, luminance
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Contribution, Interaction, LightChoice, LightSample, ShadingScene, WaveData

VISIBILITY_MOST = 2.0
"""Largest visibility that is stored. It exceeds 1 where a part of an extended light is brighter than its centre."""

UNKNOWN_WEIGHT = 0.3
"""Weight in the choice of a light, or of the part of its highlight, that visibility does not show."""

MOST = wp.constant(wp.float32(VISIBILITY_MOST))
UNKNOWN = wp.constant(wp.float32(UNKNOWN_WEIGHT))
NARROW = wp.constant(wp.float32(0.25))
"""The highlight of a light up to this wide, in radians over GGX's alpha, is remembered; wider ones in part."""

WIDE = wp.constant(wp.float32(0.75))
"""The highlight of a light wider than this, in radians over GGX's alpha, is sampled."""

LightValues = wp.types.vector(length=GRID_LIGHTS, dtype=wp.float32)

LightColors = wp.types.matrix(shape=(GRID_LIGHTS, 3), dtype=wp.float32)


@struct
class LightVisibility:
    """Visibilities of all lights at the splat surfaces, or mesh surfaces, of pixels."""

    packed: wp.array2d[wp.uint64]
    """Visibility of each light by channel, see `pack`; shape (pixels, lights). Empty: none is remembered."""
    counts: wp.array2d[wp.uint8]
    """Number of samples in each visibility; 0: the light has no sample yet, and the visibility is a guess."""


@struct
class VisibilitySample:
    """The sampled light's visibility, for each pixel."""

    light: wp.array[int]
    """Index of the sampled light; -1: the pixel has no sample."""
    visibility: wp.array[wp.vec3]
    """Visibility by channel, 0..`VISIBILITY_MOST`."""


BITS_21 = wp.constant(wp.uint64(21))
BITS_42 = wp.constant(wp.uint64(42))
LOW_21 = wp.constant(wp.uint64(2097151))
STEPS = wp.constant(wp.float32(1048575.0))
"""Number of steps from 0 to 1; `VISIBILITY_MOST` is twice as many."""


@wp.func
def pack(visibility: wp.vec3) -> wp.uint64:
    """Packs the visibility of a light by channel, 0..`VISIBILITY_MOST`, 21 bits each; 0 and 1 are exact."""
    red = wp.uint64(STEPS * wp.clamp(visibility[0], 0.0, MOST) + 0.5)
    green = wp.uint64(STEPS * wp.clamp(visibility[1], 0.0, MOST) + 0.5)
    blue = wp.uint64(STEPS * wp.clamp(visibility[2], 0.0, MOST) + 0.5)
    return red | wp.lshift(green, BITS_21) | wp.lshift(blue, BITS_42)


@wp.func
def unpack(packed: wp.uint64) -> wp.vec3:
    """Returns the visibility that `pack` has packed."""
    red = float(packed & LOW_21)
    green = float(wp.rshift(packed, BITS_21) & LOW_21)
    blue = float(wp.rshift(packed, BITS_42) & LOW_21)
    return wp.vec3(red / STEPS, green / STEPS, blue / STEPS)


@wp.func
def has_visibility(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether pixels remember the visibility of light ``number``: a point light, spot, sun or headlight."""
    if number >= scene[0].settings[0].light_count:
        return False
    kind = scene[0].lights[number].kind
    return kind == LIGHT_POINT or kind == LIGHT_SPOT or kind == LIGHT_DIRECTIONAL or kind == LIGHT_HEADLIGHT  # noqa: PLR1714


@wp.func
def remembered_highlight(radius: float, lobe: Lobe) -> float:
    """Returns which fraction of the highlight of a light of this radius visibility shows; the rest is sampled.

    The highlight of a narrow light has the shape of the microfacets, that of a wide one the light's own. In between,
    the fraction falls slowly, because samples follow light only within some frames. ``radius`` is `angular_radius`.
    """
    if lobe.specular <= 0.0:
        return 1.0
    return wp.clamp((WIDE - radius / lobe.alpha) / (WIDE - NARROW), 0.0, 1.0)


@wp.func
def is_learnt(number: int, position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether samples can tell the visibility of a light at an opaque surface.

    They cannot if the whole light is below the horizon, if it has neither shadows nor extent, or if the surface is out
    of its range or cone. Light ``number`` must be one that pixels remember.
    """
    radius = angular_radius(number, position, scene)
    if radius <= 0.0 and not casts_shadow(number, scene):
        return False
    center = sample_light(scene[0].lights[number], position, 0, wp.vec2(0.5))
    return wp.dot(normal, center.direction) > -radius and not is_black(center.irradiance)


@wp.func
def may_be_moved(
    number: int, position: wp.vec3, moved: int, boxes: wp.array[MovedBox], scene: wp.array[ShadingScene]
) -> bool:
    """Returns whether light on its way from light ``number`` to a point may meet one of the first ``moved`` boxes."""
    center = sample_light(scene[0].lights[number], position, 0, wp.vec2(0.5))
    radius = angular_radius(number, position, scene)
    reach = reach_of(number, center.distance, scene)
    for k in range(moved):
        to_box = boxes[k].center - position
        # A cone of light has this radius at the far end of the box.
        wide = radius * (wp.length(to_box) + wp.length(boxes[k].half))
        entry = float(0.0)
        end = float(reach)
        for axis in range(3):
            half = boxes[k].half[axis] + wide
            along = center.direction[axis]
            if wp.abs(along) > 1.0e-6:
                a = (to_box[axis] - half) / along
                b = (to_box[axis] + half) / along
                entry = wp.max(entry, wp.min(a, b))
                end = wp.min(end, wp.max(a, b))
            elif wp.abs(to_box[axis]) > half:
                end = -1.0
        if entry <= end:
            return True
    return False


@wp.func
def sample_variance(visibility: float, count: float) -> float:
    """Returns the variance of shadow rays of which ``count`` had the mean ``visibility``, by Laplace's rule."""
    share = (wp.clamp(visibility, 0.0, 1.0) * count + 1.0) / (count + 2.0)
    return share * (1.0 - share)


@wp.func
def choice_weight(
    number: int,
    pixel: int,
    interaction: Interaction,
    lobe: Lobe,
    remembered: LightVisibility,
    scene: wp.array[ShadingScene],
) -> float:
    """Returns how often light ``number`` is sampled, relative to others: unshadowed light times uncertainty."""
    if has_visibility(number, scene) and not transmits(interaction.bsdf):
        if not is_learnt(number, interaction.position, interaction.normal, scene):
            return 0.0
    importance = light_importance(number, interaction.position, interaction.normal, scene)
    if lobe.specular <= 0.0 and not has_visibility(number, scene):
        return UNKNOWN * importance
    weight = float(0.0)
    shown = float(0.0)
    if has_visibility(number, scene):
        shown = remembered_highlight(angular_radius(number, interaction.position, scene), lobe)
        count = float(remembered.counts[pixel, number])
        variance = sample_variance(luminance(unpack(remembered.packed[pixel, number])), count)
        weight = wp.sqrt(variance / (count + 1.0)) * importance
        if lobe.specular > 0.0:
            weight *= lobe.diffuse + shown * lobe.specular
    if shown < 1.0:
        weight += UNKNOWN * (1.0 - shown) * lobe_importance(number, importance, interaction, lobe, scene)
    return weight


@wp.func
def light_by_weight(u: float, weights: LightValues, total: float, count: int) -> LightChoice:
    """Chooses one of ``count`` lights in proportion to its weight; -1: ``total``, their sum, is 0 or not finite."""
    choice = LightChoice()
    choice.number = -1
    if not (total > 0.0 and total < wp.inf):
        return choice
    rest = u * total
    for number in range(count):
        if weights[number] > 0.0 and rest >= 0.0:
            choice.number = number
            choice.probability = weights[number] / total
            rest -= weights[number]
    return choice


@wp.func
def light_by_uncertainty(
    u: float, pixel: int, interaction: Interaction, remembered: LightVisibility, scene: wp.array[ShadingScene]
) -> LightChoice:
    """Chooses one of at most `GRID_LIGHTS` lights, by unshadowed light times uncertainty; -1: none."""
    lobe = lobe_at(interaction)
    weights = LightValues()
    total = float(0.0)
    count = choice_count(scene)
    for number in range(count):
        weights[number] = choice_weight(number, pixel, interaction, lobe, remembered, scene)
        total += weights[number]
    return light_by_weight(u, weights, total, count)


@struct
class RememberedSample:
    """A sample of a light whose visibility is remembered, and how much of it is shown as filtered samples."""

    contribution: Contribution
    """Unshadowed contribution, divided by the probability of the light."""
    diffuse: float
    """Factor of the diffuse light that the visibility leaves out."""
    glossy: float
    """Factor of the highlight that the visibility leaves out, and of the part of it that is sampled."""


@wp.func
def sample_remembered(
    i: int,
    slot: int,
    choice: LightChoice,
    shown: float,
    interaction: Interaction,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    light_out: PixelLight,
    rays: RayData,
) -> RememberedSample:
    """Samples the visibility of the chosen light and starts its shadow ray; returns what the visibility leaves out.

    Of the highlight, the visibility shows the fraction ``shown``. The rest is sampled by light or highlight
    (`lobe_chance`); samples by the highlight tell nothing of the visibility of the whole light.
    """
    number = choice.number
    result = RememberedSample()
    key = wave[0].rays.pixel_key[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), wave[0].rays.sample[i])
    chance = float(0.0)
    if shown < 1.0:
        chance = lobe_chance(number, interaction, scene)
    sample = LightSample()
    if u[0] < chance:
        which = sobol_2d(branch_key(key, CHOICE_BRANCH), wave[0].rays.sample[i])[1]
        sample = sample_by_lobe(number, chance, interaction, wp.vec2(u[0] / chance, u[1]), which, scene)
        result.glossy = 1.0 - shown
    else:
        light = scene[0].lights[number]
        center = sample_light(light, interaction.position, 0, wp.vec2(0.5))
        expected = luminance(irradiance_of(interaction, center))
        at = wp.vec2((u[0] - chance) / (1.0 - chance), u[1])
        sample = sample_light(light, interaction.position, scene[0].settings[0].soft, at)
        left_out = float(1.0)
        if expected > 0.0:
            ratio = luminance(irradiance_of(interaction, sample)) / expected
            left_out = 1.0 - MOST / wp.max(ratio, MOST)
            light_out.light[i] = number
            light_out.ratio[i] = wp.min(ratio, MOST)
        result.diffuse = left_out / (1.0 - chance)
        result.glossy = shown * result.diffuse + (1.0 - shown) * weight_beside_lobe(sample, chance, interaction)
    result.contribution = contribution_of(interaction, sample, 1.0 / choice.probability)
    if not (is_black(result.contribution.color) or no_shadows) and casts_shadow(number, scene):
        start_chosen_ray(i, slot, number, result.contribution, scene, wave, rays)
    return result
