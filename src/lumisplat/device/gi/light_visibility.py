"""Visibility of lights at pixels: which fraction of each light's unshadowed irradiance arrived in earlier frames.

Unshadowed light of lamps and suns is computed anew in each frame; only its visibility is remembered
(docs/method/realtime.md#visibility).
"""

import warp as wp

from lumisplat.constants import GRID_LIGHTS
from lumisplat.device.gi.surfaces import PixelLight
from lumisplat.device.light.direct_light import (
    POINT_BRANCH,
    casts_shadow,
    choice_count,
    contribution_of,
    irradiance_of,
    light_importance,
    start_chosen_ray,
)
from lumisplat.device.light.light import LIGHT_DIRECTIONAL, LIGHT_HEADLIGHT, LIGHT_POINT, LIGHT_SPOT, sample_light
from lumisplat.device.light.lobe_lights import Lobe, angular_radius, lobe_at, lobe_importance
from lumisplat.device.material.bsdf import diffuse_share
from lumisplat.device.math.color import is_black, luminance
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Interaction, LightChoice, ShadingScene, WaveData

VISIBILITY_MOST = 2.0
"""Largest visibility that is stored. It exceeds 1 where a part of an extended light is brighter than its centre."""

UNKNOWN_WEIGHT = 0.3
"""Weight in the choice of a light whose visibility is not remembered."""

MOST = wp.constant(wp.float32(VISIBILITY_MOST))
UNKNOWN = wp.constant(wp.float32(UNKNOWN_WEIGHT))
NARROW = wp.constant(wp.float32(0.25))
"""The highlight of a light wider than this fraction of the lobe's width, in radians over alpha, is sampled."""

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
def is_remembered(number: int, interaction: Interaction, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether light ``number`` lights a surface by its visibility.

    Metals whose highlight is narrower than four times the light sample it instead.
    """
    if not has_visibility(number, scene):
        return False
    lobe = lobe_at(interaction)
    if lobe.specular <= lobe.diffuse:
        return True
    return angular_radius(number, interaction.position, scene) <= NARROW * lobe.alpha


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
    importance = light_importance(number, interaction.position, interaction.normal, scene)
    if lobe.specular > lobe.diffuse:
        importance = lobe_importance(number, importance, interaction, lobe, scene)
    if not is_remembered(number, interaction, scene):
        return UNKNOWN * importance
    count = float(remembered.counts[pixel, number])
    variance = sample_variance(luminance(unpack(remembered.packed[pixel, number])), count)
    return wp.sqrt(variance / (count + 1.0)) * importance


@wp.func
def light_by_uncertainty(
    u: float, pixel: int, interaction: Interaction, remembered: LightVisibility, scene: wp.array[ShadingScene]
) -> LightChoice:
    """Chooses one of at most `GRID_LIGHTS` lights, by unshadowed light times uncertainty; -1: none."""
    choice = LightChoice()
    choice.number = -1
    lobe = lobe_at(interaction)
    weights = LightValues()
    total = float(0.0)
    count = choice_count(scene)
    for number in range(count):
        weights[number] = choice_weight(number, pixel, interaction, lobe, remembered, scene)
        total += weights[number]
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
def sample_remembered(
    i: int,
    slot: int,
    choice: LightChoice,
    interaction: Interaction,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    light_out: PixelLight,
    rays: RayData,
):
    """Samples the visibility of the chosen light and starts its shadow ray; writes what the visibility leaves out."""
    number = choice.number
    light = scene[0].lights[number]
    center = sample_light(light, interaction.position, 0, wp.vec2(0.5))
    expected = luminance(irradiance_of(interaction, center))
    at = sobol_2d(branch_key(wave[0].rays.pixel_key[i], POINT_BRANCH), wave[0].rays.sample[i])
    sample = sample_light(light, interaction.position, scene[0].settings[0].soft, at)
    left_out = float(1.0)
    if expected > 0.0:
        ratio = luminance(irradiance_of(interaction, sample)) / expected
        left_out = 1.0 - MOST / wp.max(ratio, MOST)
        light_out.light[i] = number
        light_out.ratio[i] = wp.min(ratio, MOST)
    contribution = contribution_of(interaction, sample, 1.0 / choice.probability)
    if is_black(contribution.color):
        return
    if left_out > 0.0:
        share = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, contribution.direction)
        diffuse = wp.cw_mul(share, contribution.color)
        light_out.diffuse[i] = left_out * diffuse
        light_out.glossy[i] = left_out * (contribution.color - diffuse)
    if not no_shadows and casts_shadow(number, scene):
        start_chosen_ray(i, slot, number, contribution, scene, wave, rays)
