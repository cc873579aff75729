"""Direct light at a surface: selection of a light, sampling, MIS weights, and shadow rays.

All integrators estimate direct light with these functions; they differ in the lights that they sample:

- The Whitted integrator samples every light, at its centre or at a random point of its extent. It samples the
  environment twice, by radiance and by the BSDF (``light_contribution``).
- The path integrator selects one light by importance (``chosen_light``, ``sample_chosen``); its own rays also hit some
  lights.
- Real-time rendering selects one light likewise, or from a cell of the light grid (``sample_choice``).

The equations are in docs/method/lighting.md and docs/method/paths.md#lights.
"""

import warp as wp

from lumisplat.constants import LUMINANCE
from lumisplat.device.light.emitters import (
    environment_pdf,
    environment_radiance,
    sample_emitter,
    sample_environment,
)
from lumisplat.device.light.light import LIGHT_ENVIRONMENT, sample_light
from lumisplat.device.light.shadow_rays import start_shadow_ray
from lumisplat.device.material.bsdf import bsdf_eval, bsdf_pdf, bsdf_sample, view_albedo
from lumisplat.device.material.microfacets import transmits
from lumisplat.device.math.color import is_black
from lumisplat.device.math.directions import PI
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs import struct
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import (
    BSDF_SIMPLE,
    Bsdf,
    Contribution,
    Interaction,
    LightChoice,
    LightSample,
    PathVertex,
    ShadingScene,
    WaveData,
)


@struct
class SampledLight:
    """Contribution of one light sample at a surface of a path."""

    contribution: Contribution
    """Contribution multiplied by the MIS weight, because path rays may also hit the light."""
    unweighted: wp.vec3
    """Colour of the contribution without the MIS weight."""


LIGHT_COSINE_MIN = 0.1
"""Smallest cosine assumed when a light is selected, because parts of an extended light may be above the horizon."""

LIGHT_BRANCHES = wp.constant(2)
"""First branch of a ray's key that lights use for random numbers; branches 0 and 1 belong to the ray's two bounces."""

BSDF_BRANCHES = wp.constant(2)
"""First branch of a light's key that its shadow rays use; branches 0 and 1 belong to samples of the BSDF."""

# Random branches of a ray's key where one light is selected.
POINT_BRANCH = wp.constant(2)
"""Random branch that selects a point of the light's extent."""

CHOICE_BRANCH = wp.constant(3)
"""Random branch that selects the light and, among emissive triangles, the triangle."""

SHADOW_BRANCH = wp.constant(5)
"""Random branch of the shadow ray, independent of the branch that selected the point of the light."""

WEIGHTS = wp.constant(wp.vec3(*LUMINANCE))

COSINE_MIN = wp.constant(wp.float32(LIGHT_COSINE_MIN))

TINY = wp.constant(wp.float32(1e-30))

# --- Selection of a light; emissive triangles are one more light after all others ---


@wp.func
def choice_count(scene: wp.array[ShadingScene]) -> int:
    """Returns the number of lights that paths select from; emissive triangles together count as one."""
    return scene[0].settings[0].light_count + wp.where(scene[0].emitters.ends.shape[0] > 0, 1, 0)


@wp.func
def is_environment(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether light ``number`` is the environment.

    The emissive triangles are one more light, numbered after all others.
    """
    if number == scene[0].settings[0].light_count:
        return False
    return scene[0].lights[number].kind == LIGHT_ENVIRONMENT


@wp.func
def casts_shadow(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether objects cast shadows in the light of light ``number``; they always do for emissive meshes."""
    if number == scene[0].settings[0].light_count:
        return True
    return scene[0].lights[number].casts_shadow != 0


@wp.func
def uses_mis(number: int, no_shadows: bool, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether rays scattered at surfaces also find light ``number``, so that its samples need MIS weights.

    The result is False for lights without extent, which rays cannot hit. It is False, too, for lights whose samples
    ignore objects that block rays, or are shadowed in another way than rays.
    """
    if no_shadows or scene[0].settings[0].changes_shadows != 0:
        return False
    if number == scene[0].settings[0].light_count:
        return True
    light = scene[0].lights[number]
    if light.casts_shadow == 0:
        return False
    if light.kind == LIGHT_ENVIRONMENT:
        return light.range == wp.inf
    return light.visible != 0


@wp.func
def light_importance(number: int, position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """Estimates the irradiance of a surface point by light ``number``; above 0 wherever the light contributes."""
    if number == scene[0].settings[0].light_count:
        emitters = scene[0].emitters
        away = emitters.center - position
        return emitters.power / wp.max(wp.max(wp.dot(away, away), emitters.radius * emitters.radius), TINY)
    light = scene[0].lights[number]
    if light.kind == LIGHT_ENVIRONMENT:
        return PI * scene[0].environment.mean
    sample = sample_light(light, position, 0, wp.vec2(0.5))
    cosine = wp.max(wp.dot(normal, sample.direction), COSINE_MIN)  # parts of soft lights may be above the horizon
    return cosine * wp.dot(WEIGHTS, sample.irradiance)


@wp.func
def total_importance(position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """Estimates the irradiance of a surface point by all lights."""
    total = float(0.0)
    for number in range(choice_count(scene)):
        total += light_importance(number, position, normal, scene)
    return total


@wp.func
def vertex_without_importance(interaction: Interaction) -> PathVertex:
    """Returns position and normal of an interaction as a path vertex; its importance is not set."""
    vertex = PathVertex()
    vertex.position = interaction.position
    vertex.normal = interaction.normal
    if transmits(interaction.bsdf):
        vertex.normal = wp.vec3(0.0)  # light from both sides counts
    return vertex


@wp.func
def vertex_at(interaction: Interaction, scene: wp.array[ShadingScene]) -> PathVertex:
    """Returns an interaction as a path vertex: position, normal, and the importance of all lights."""
    vertex = vertex_without_importance(interaction)
    vertex.importance = total_importance(vertex.position, vertex.normal, scene)
    return vertex


@wp.func
def chosen_light(u: float, vertex: PathVertex, scene: wp.array[ShadingScene]) -> LightChoice:
    """Selects a light for a path vertex in proportion to its importance there; ``u`` is random, 0..1."""
    choice = LightChoice()
    choice.number = -1
    if not (vertex.importance > 0.0 and vertex.importance < wp.inf):
        return choice
    rest = u * vertex.importance
    for number in range(choice_count(scene)):
        importance = light_importance(number, vertex.position, vertex.normal, scene)
        if importance > 0.0 and rest >= 0.0:
            choice.number = number
            choice.probability = importance / vertex.importance
            rest -= importance
    return choice


@wp.func
def choice_probability(number: int, vertex: PathVertex, scene: wp.array[ShadingScene]) -> float:
    """Returns the probability with which ``chosen_light`` selects light ``number`` for a path vertex."""
    if not (vertex.importance > 0.0 and vertex.importance < wp.inf):
        return 0.0
    return light_importance(number, vertex.position, vertex.normal, scene) / vertex.importance


@wp.func
def environment_number(scene: wp.array[ShadingScene]) -> int:
    """Returns the index of the light that is the environment; -1: the scene has no environment light."""
    for number in range(scene[0].settings[0].light_count):
        if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
            return number
    return -1


# --- Light samples and their contributions ---


@wp.func
def arrives(interaction: Interaction, direction: wp.vec3) -> bool:
    """Returns whether light from a direction arrives at an interaction: above its horizon or, at rough glass, below."""
    cosine = wp.dot(interaction.normal, direction)
    above = wp.dot(interaction.horizon_normal, direction)
    if cosine < 0.0 and above < 0.0:
        return transmits(interaction.bsdf)
    return cosine > 0.0 and above > 0.0


@wp.func
def irradiance_of(interaction: Interaction, sample: LightSample) -> wp.vec3:
    """Returns the unshadowed irradiance at an interaction by a light sample."""
    if not arrives(interaction, sample.direction):
        return wp.vec3(0.0)
    return wp.abs(wp.dot(interaction.normal, sample.direction)) * sample.irradiance


@wp.func
def contribution_of(interaction: Interaction, sample: LightSample, share: float) -> Contribution:
    """Returns the contribution of a light sample, times ``share``, to the ray's radiance.

    For a shadow catcher, the contribution is irradiance.
    """
    irradiance = share * irradiance_of(interaction, sample)
    result = Contribution()
    if is_black(irradiance):
        return result
    result.direction = sample.direction
    result.distance = sample.distance
    result.color = irradiance
    if not interaction.shadow_catcher:
        reflectance = bsdf_eval(interaction.bsdf, interaction.normal, interaction.wo, sample.direction)
        result.color = interaction.weight * wp.cw_mul(reflectance, irradiance)
    return result


@wp.func
def power_heuristic(pdf: float, other: float) -> float:
    """Returns the MIS weight of a sample with pdf ``pdf`` if another strategy samples its direction with ``other``."""
    if pdf <= 0.0:
        return 0.0
    ratio = other / pdf
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def environment_sample(
    samples_bsdf: bool,
    bsdf: Bsdf,
    interaction: Interaction,
    u: wp.vec2,
    choice: float,
    scene: wp.array[ShadingScene],
) -> LightSample:
    """Draws one of two samples of the environment: by its radiance or, if ``samples_bsdf``, by a BSDF.

    The samples are weighted by the balance heuristic (Veach and Guibas 1995), so that the sum of both is an unbiased
    estimate.

    ``bsdf`` is the BSDF of the surface or a part of it. ``u`` is random, 0..1 each; ``choice``, random, 0..1, selects a
    lobe.
    """
    sample = LightSample()
    environment = scene[0].environment
    if samples_bsdf:
        sampled = bsdf_sample(bsdf, interaction.normal, interaction.wo, u, choice)
        sample.direction = sampled.direction
        sample.distance = wp.inf
        if sampled.pdf > 0.0:
            both = sampled.pdf + environment_pdf(environment, sampled.direction)
            sample.irradiance = environment_radiance(environment, sampled.direction) / both
    else:
        sample = sample_environment(environment, u)
        if sample.pdf > 0.0:
            other = bsdf_pdf(bsdf, interaction.normal, interaction.wo, sample.direction)
            sample.irradiance = sample.irradiance * (sample.pdf / (sample.pdf + other))
    return sample


# --- Every light in turn ---


@wp.func
def light_key(pixel_key: wp.uint32, number: int) -> wp.uint32:
    """Returns the key of the random sequence that samples light ``number`` for all samples of a pixel."""
    return branch_key(pixel_key, LIGHT_BRANCHES + number)


@wp.func
def shadow_ray_key(key: wp.uint32, number: int, samples_bsdf: bool, slot: int) -> wp.uint32:
    """Returns the random key of the shadow ray from interaction ``slot`` of a ray towards light ``number``."""
    return branch_key(light_key(key, number), BSDF_BRANCHES + slot + 2 * int(samples_bsdf))


@wp.func
def light_center_contribution(number: int, interaction: Interaction, scene: wp.array[ShadingScene]) -> Contribution:
    """Returns the contribution of light ``number``, sampled at its centre; the light must not be the environment."""
    sample = sample_light(scene[0].lights[number], interaction.position, 0, wp.vec2(0.5))
    return contribution_of(interaction, sample, 1.0)


@wp.func
def light_sample_contribution(
    number: int, interaction: Interaction, pixel_key: wp.uint32, index: int, scene: wp.array[ShadingScene]
) -> Contribution:
    """Returns the contribution of light ``number``, sampled at a random point of its extent.

    The light must not be the environment. ``index`` is the index of the ray's sample.
    """
    u = sobol_2d(light_key(pixel_key, number), index)
    sample = sample_light(scene[0].lights[number], interaction.position, 1, u)
    return contribution_of(interaction, sample, 1.0)


@wp.func
def environment_contribution(
    number: int,
    samples_bsdf: bool,
    interaction: Interaction,
    pixel_key: wp.uint32,
    index: int,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Returns the contribution of the environment, light ``number``, by one of the two ``environment_sample`` draws."""
    key = light_key(pixel_key, number)
    u = sobol_2d(key, index)
    choice = float(0.0)
    if samples_bsdf:
        u = sobol_2d(branch_key(key, 0), index)
        choice = sobol_2d(branch_key(key, 1), index)[0]
    sample = environment_sample(samples_bsdf, interaction.bsdf, interaction, u, choice, scene)
    return contribution_of(interaction, sample, interaction.occlusion)


@wp.func
def light_contribution(
    number: int,
    samples_bsdf: bool,
    interaction: Interaction,
    pixel_key: wp.uint32,
    index: int,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Returns the contribution of light ``number`` along one shadow ray.

    The environment is sampled by its radiance or, if ``samples_bsdf``, by the BSDF. Other lights are sampled at a
    random point for soft shadows, and at their centre for hard shadows.
    """
    contribution = Contribution()
    if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
        contribution = environment_contribution(number, samples_bsdf, interaction, pixel_key, index, scene)
    elif scene[0].settings[0].soft != 0:
        contribution = light_sample_contribution(number, interaction, pixel_key, index, scene)
    else:
        contribution = light_center_contribution(number, interaction, scene)
    return contribution


# --- One randomly selected light ---


@wp.func
def sample_chosen(
    choice: LightChoice,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    with_mis: bool,
    scene: wp.array[ShadingScene],
) -> SampledLight:
    """Samples a selected light at an interaction; the contribution is divided by the selection probability.

    ``u`` and ``which`` are random, 0..1; ``with_mis``: whether rays scattered at the surface find the light, too, see
    ``uses_mis``.
    """
    sample = LightSample()
    if choice.number == scene[0].settings[0].light_count:
        sample = sample_emitter(interaction.position, u, which, scene)
    else:
        light = scene[0].lights[choice.number]
        if light.kind == LIGHT_ENVIRONMENT:
            sample = sample_environment(scene[0].environment, u)
        else:
            sample = sample_light(light, interaction.position, scene[0].settings[0].soft, u)
    weight = float(1.0)
    if with_mis and sample.pdf > 0.0:
        pdf = bsdf_pdf(interaction.bsdf, interaction.normal, interaction.wo, sample.direction)
        weight = power_heuristic(choice.probability * sample.pdf, pdf)
    result = SampledLight()
    result.contribution = contribution_of(interaction, sample, 1.0 / choice.probability)
    result.unweighted = result.contribution.color
    result.contribution.color = weight * result.unweighted
    return result


@wp.func
def half_highlight(bsdf: Bsdf, cos_view: float) -> Bsdf:
    """Returns a BSDF for sampling, whose diffuse part is reduced to at most the albedo of the highlight.

    At least half of its samples are then drawn from the highlight. Otherwise, samples in the highlight would be rare
    and bright.
    """
    half = bsdf
    mirrored = bsdf.specular
    if bsdf.model != BSDF_SIMPLE:
        mirrored = view_albedo(bsdf, cos_view)
    if not is_black(mirrored):
        half.diffuse = wp.min(bsdf.diffuse, mirrored)
    half.rescattered = wp.vec3(0.0)
    return half


@wp.func
def sample_chosen_environment(
    choice: LightChoice,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Samples the selected environment and divides the contribution by the selection probability.

    The sample is drawn by radiance or by the surface's BSDF, which ``u[0]`` selects, so that both kinds are stratified
    together. ``u`` and ``which`` are random, 0..1.
    """
    lobe = half_highlight(interaction.bsdf, wp.dot(interaction.normal, interaction.wo))
    samples_lobe = u[0] >= 0.5
    remapped = wp.vec2(2.0 * u[0] - wp.where(samples_lobe, 1.0, 0.0), u[1])
    sample = environment_sample(samples_lobe, lobe, interaction, remapped, which, scene)
    return contribution_of(interaction, sample, 2.0 / choice.probability)


@wp.func
def start_chosen_ray(
    i: int,
    slot: int,
    number: int,
    contribution: Contribution,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays: RayData,
):
    """Starts shadow ray ``i``, from surface ``slot`` of ray ``i`` towards its sampled light."""
    j = slot * wave[0].rays.is_active.shape[0] + i
    start_shadow_ray(i, j, number, contribution, scene, wave, rays)
    rays.pixel_key[i] = branch_key(wave[0].rays.pixel_key[i], SHADOW_BRANCH)
    rays.sample_key[i] = branch_key(wave[0].rays.sample_key[i], SHADOW_BRANCH)
    rays.sample[i] = wave[0].rays.sample[i]


@wp.func
def sample_choice(
    i: int,
    slot: int,
    choice: LightChoice,
    interaction: Interaction,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays: RayData,
) -> Contribution:
    """Samples the light that real-time rendering has selected, and starts shadow ray ``i`` if it is needed.

    ``slot`` is the lit surface of ray ``i``: 0 for Gaussians, 1 for a mesh. Shadow ray ``i`` must be inactive before.
    """
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)[1]
    contribution = Contribution()
    if is_environment(choice.number, scene):
        contribution = sample_chosen_environment(choice, interaction, u, which, scene)
    else:
        contribution = sample_chosen(choice, interaction, u, which, False, scene).contribution
    if is_black(contribution.color) or no_shadows or not casts_shadow(choice.number, scene):
        return contribution
    start_chosen_ray(i, slot, choice.number, contribution, scene, wave, rays)
    return contribution
