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
    BRIGHTEST,
    candidate_count,
    environment_pdf,
    environment_radiance,
    sample_candidate,
    sample_emitter,
    sample_environment,
)
from lumisplat.device.light.glossy_lobe import highlight_of
from lumisplat.device.light.light import LIGHT_ENVIRONMENT, sample_light
from lumisplat.device.light.lobe_lights import (
    CROSSED_MAX,
    crossing_of,
    emitter_crossing,
    lobe_at,
    lobe_chance,
    most_by_lobe,
)
from lumisplat.device.light.shadow_rays import start_shadow_ray
from lumisplat.device.material.bsdf import BsdfSample, bsdf_eval, bsdf_pdf, bsdf_sample, view_albedo
from lumisplat.device.material.microfacets import transmits
from lumisplat.device.math.color import is_black, luminance
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
    """Result of sampling one light at a surface point of a path, with and without the MIS weight."""

    contribution: Contribution
    """Unshadowed contribution times its MIS weight. The competing strategy is rays sampled by the BSDF that hit the
    light."""
    unweighted: wp.vec3
    """Linear colour of the unshadowed contribution without the MIS weight."""


LIGHT_COSINE_MIN = 0.1
"""When lights are selected, the cosine between surface normal and direction to a light's centre counts as at least
this.

Parts of an extended light may be above the horizon although its centre is not."""

LIGHT_BRANCHES = wp.constant(2)
"""Light ``number`` derives its random numbers from branch ``2 + number`` of a ray's key; 0 and 1 are for its bounces.
"""

BSDF_BRANCHES = wp.constant(2)
"""First branch of a light's random key for shadow rays; branches 0 and 1 sample the environment by the BSDF."""

# Random branches of a ray's key where one light is selected.
POINT_BRANCH = wp.constant(2)
"""Branch of a ray's random key for the point on the extent of the one selected light."""

CHOICE_BRANCH = wp.constant(3)
"""Branch of a ray's random key that selects one light and, if it is a mesh, one of the emissive triangles."""

SHADOW_BRANCH = wp.constant(5)
"""Branch of a ray's random key for the shadow ray towards the one selected light."""

EMITTER_BRANCH = wp.constant(9)
"""Branch of a ray's random key for the candidates of `resampled_emitters`."""

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

    A number equal to the count of lights stands for the emissive triangles and gives False.
    """
    if number == scene[0].settings[0].light_count:
        return False
    return scene[0].lights[number].kind == LIGHT_ENVIRONMENT


@wp.func
def casts_shadow(number: int, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether objects block light ``number``; always True for emissive triangles, numbered after all lights."""
    if number == scene[0].settings[0].light_count:
        return True
    return scene[0].lights[number].casts_shadow != 0


@wp.func
def uses_mis(number: int, no_shadows: bool, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether samples of light ``number`` need MIS weights, because scattered rays also hit the light.

    It is False for point-like lights, because rays cannot hit them, and for lights whose samples have no shadows, or
    shadows only up to a distance. It is always False if shadow rays use a threshold or tint. ``no_shadows``: shadows
    are switched off for the frame.
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
def emitter_importance(center: wp.vec3, radius: float, power: float, position: wp.vec3) -> float:
    """Returns ``light_importance`` of all emissive triangles, which a sphere around ``center`` contains."""
    away = center - position
    return power / wp.max(wp.max(wp.dot(away, away), radius * radius), TINY)


@wp.func
def light_importance(number: int, position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """Estimates the luminance of the unshadowed irradiance by light ``number`` at a point; above 0 if it contributes.

    Emissive triangles count as one light, numbered after all others.
    """
    if number == scene[0].settings[0].light_count:
        emitters = scene[0].emitters
        return emitter_importance(emitters.center, emitters.radius, emitters.power, position)
    light = scene[0].lights[number]
    if light.kind == LIGHT_ENVIRONMENT:
        return PI * scene[0].environment.mean
    sample = sample_light(light, position, 0, wp.vec2(0.5))
    cosine = wp.max(wp.dot(normal, sample.direction), COSINE_MIN)  # parts of soft lights may be above the horizon
    return cosine * wp.dot(WEIGHTS, sample.irradiance)


@wp.func
def total_importance(position: wp.vec3, normal: wp.vec3, scene: wp.array[ShadingScene]) -> float:
    """Returns the sum of ``light_importance``, the estimated irradiance at a surface point, over all lights."""
    total = float(0.0)
    for number in range(choice_count(scene)):
        total += light_importance(number, position, normal, scene)
    return total


@wp.func
def vertex_without_importance(interaction: Interaction) -> PathVertex:
    """Returns position and normal of an interaction as a path vertex, whose ``importance`` stays 0.

    The normal is zero at rough glass, which light reaches from both sides.
    """
    vertex = PathVertex()
    vertex.position = interaction.position
    vertex.normal = interaction.normal
    if transmits(interaction.bsdf):
        vertex.normal = wp.vec3(0.0)  # light from both sides counts
    return vertex


@wp.func
def vertex_at(interaction: Interaction, scene: wp.array[ShadingScene]) -> PathVertex:
    """Returns an interaction as a path vertex: position, normal, and the estimated irradiance by all lights."""
    vertex = vertex_without_importance(interaction)
    vertex.importance = total_importance(vertex.position, vertex.normal, scene)
    return vertex


@wp.func
def chosen_light(u: float, vertex: PathVertex, scene: wp.array[ShadingScene]) -> LightChoice:
    """Selects a light with probability ``light_importance / vertex.importance``; ``u`` is random, 0..1.

    The index is -1 if the estimated irradiance by all lights is 0 or not finite.
    """
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
    """Returns whether light from ``direction`` reaches the surface: above its horizon or, at rough glass, below.

    Shading normal and horizon normal must agree on the side.
    """
    cosine = wp.dot(interaction.normal, direction)
    above = wp.dot(interaction.horizon_normal, direction)
    if cosine < 0.0 and above < 0.0:
        return transmits(interaction.bsdf)
    return cosine > 0.0 and above > 0.0


@wp.func
def irradiance_of(interaction: Interaction, sample: LightSample) -> wp.vec3:
    """Returns the irradiance by a light sample, without shadow, on the surface: ``|cosine| * sample.irradiance``.

    It is zero if the light comes from below the horizon of an opaque surface.
    """
    if not arrives(interaction, sample.direction):
        return wp.vec3(0.0)
    return wp.abs(wp.dot(interaction.normal, sample.direction)) * sample.irradiance


@wp.func
def contribution_of(interaction: Interaction, sample: LightSample, share: float) -> Contribution:
    """Returns the unshadowed contribution of a light sample to the ray's radiance, multiplied by ``share``.

    For a shadow catcher, the colour is irradiance instead of radiance.
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
    """Returns the MIS weight ``pdf^2 / (pdf^2 + other^2)``; ``other`` is the pdf of the other sampling strategy."""
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
    """Samples a direction to the environment: by the environment's radiance or, if ``samples_bsdf``, by a BSDF.

    The caller adds one sample of each kind: the balance heuristic (Veach and Guibas 1995) weights them so that their
    sum is unbiased. ``bsdf`` is the surface's BSDF or a part of it. ``u`` is random, 0..1 each; ``choice``, random,
    0..1, selects a lobe.
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
    """Returns the key of the low-discrepancy sequence that samples light ``number``; a pixel's samples share it."""
    return branch_key(pixel_key, LIGHT_BRANCHES + number)


@wp.func
def shadow_ray_key(key: wp.uint32, number: int, samples_bsdf: bool, slot: int) -> wp.uint32:
    """Returns the random key of a shadow ray to light ``number`` from a ray's surface ``slot``: 0 Gaussians, 1 mesh.

    ``key`` is the ray's own key. Samples of the environment by the BSDF (``samples_bsdf``) get a key of their own.
    """
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
    """Returns the unshadowed contribution of light ``number``, sampled at a random point of its extent.

    The light must not be the environment. ``index`` is the number of the pixel's sample in the low-discrepancy
    sequence.
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
    """Returns the unshadowed contribution of the environment in one direction, sampled as in ``environment_sample``.

    ``number`` is the environment's index among the lights; ``index`` is the number of the pixel's sample.
    """
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
    """Returns the unshadowed contribution of light ``number`` along one shadow ray.

    The environment is sampled by its radiance or, if ``samples_bsdf``, by the BSDF. Other lights are sampled at a
    random point for soft shadows, and at their centre for hard shadows. ``index`` is the number of the pixel's sample.
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
def sample_of_choice(
    choice: LightChoice, position: wp.vec3, u: wp.vec2, which: float, scene: wp.array[ShadingScene]
) -> LightSample:
    """Samples the light that was selected at random, as seen from ``position``, without regard to the selection.

    ``u``, random, 0..1 each, selects the point; ``which``, random, 0..1, the emissive triangle.
    """
    if choice.number == scene[0].settings[0].light_count:
        return sample_emitter(position, u, which, scene)
    if scene[0].lights[choice.number].kind == LIGHT_ENVIRONMENT:
        return sample_environment(scene[0].environment, u)
    return sample_light(scene[0].lights[choice.number], position, scene[0].settings[0].soft, u)


@wp.func
def sample_chosen(
    choice: LightChoice,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    with_mis: bool,
    scene: wp.array[ShadingScene],
) -> SampledLight:
    """Samples the light that was selected at random; the contribution is divided by the probability of the selection.

    ``u`` and ``which`` are as for ``sample_of_choice``. ``with_mis``: weight the contribution by the power heuristic,
    because scattered rays also hit the light (see ``uses_mis``).
    """
    sample = sample_of_choice(choice, interaction.position, u, which, scene)
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
    """Returns the BSDF with its diffuse albedo reduced to the highlight's albedo, for choosing sample directions only.

    At least half of the directions then come from the highlight. Otherwise, samples in the highlight would be rare and
    bright.
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
    """Samples the environment, selected among the lights; the contribution is divided by the selection probability.

    ``u[0]`` selects whether radiance or the BSDF samples the direction; one sequence thus stratifies both strategies.
    Metals sample by the BSDF in nine of ten cases, other surfaces in half of them. ``which`` selects a lobe. ``u`` and
    ``which`` are random, 0..1.
    """
    lobe = half_highlight(interaction.bsdf, wp.dot(interaction.normal, interaction.wo))
    chance = wp.max(most_by_lobe(lobe_at(interaction)), 0.5)
    environment = scene[0].environment
    sample = LightSample()
    if u[0] >= 1.0 - chance:
        remapped = wp.vec2((u[0] - (1.0 - chance)) / chance, u[1])
        sampled = bsdf_sample(lobe, interaction.normal, interaction.wo, remapped, which)
        sample.direction = sampled.direction
        sample.distance = wp.inf
        if sampled.pdf > 0.0:
            both = chance * sampled.pdf + (1.0 - chance) * environment_pdf(environment, sampled.direction)
            sample.irradiance = environment_radiance(environment, sampled.direction) / both
    else:
        sample = sample_environment(environment, wp.vec2(u[0] / (1.0 - chance), u[1]))
        if sample.pdf > 0.0:
            pdf = bsdf_pdf(lobe, interaction.normal, interaction.wo, sample.direction)
            sample.irradiance *= sample.pdf / (chance * pdf + (1.0 - chance) * sample.pdf)
    return contribution_of(interaction, sample, 1.0 / choice.probability)


@wp.func
def resampled_emitters(
    interaction: Interaction, key: wp.uint32, index: int, scene: wp.array[ShadingScene]
) -> Contribution:
    """Samples the emissive triangles: chooses one of several points by the unshadowed light that the surface reflects.

    Candidates are points on triangles and, if these are few, all triangles in a direction by the BSDF, weighted by the
    balance heuristic, so that no near triangle or highlight is rare and bright; the shadow ray decides what is seen.
    Resampled importance sampling (Talbot et al. 2005) keeps the mean. ``index`` is the number of the pixel's sample.
    """
    emitters = branch_key(key, EMITTER_BRANCH)
    rest = sobol_2d(branch_key(key, CHOICE_BRANCH), index)[1]
    lobe = half_highlight(interaction.bsdf, wp.dot(interaction.normal, interaction.wo))
    points = candidate_count(scene)
    crossed = scene[0].emitters.ends.shape[0]
    sampled = BsdfSample()
    if crossed <= CROSSED_MAX:
        u = sobol_2d(branch_key(key, POINT_BRANCH), index)
        sampled = bsdf_sample(lobe, interaction.normal, interaction.wo, u, sobol_2d(emitters, index)[1])
    else:
        crossed = 0
    chosen = Contribution()
    total = float(0.0)
    weight = float(0.0)
    for candidate in range(points + crossed):
        sample = LightSample()
        density = float(0.0)
        if candidate < points:
            sample = sample_candidate(candidate, interaction.position, emitters, index, scene)
            density = sample.pdf
            if crossed > 0 and arrives(interaction, sample.direction):
                density += bsdf_pdf(lobe, interaction.normal, interaction.wo, sample.direction)
        elif sampled.pdf > 0.0:
            crossing = emitter_crossing(candidate - points, interaction.position, sampled.direction, scene)
            if crossing.pdf > 0.0:
                sample.direction = sampled.direction
                sample.distance = crossing.t
                sample.irradiance = crossing.radiance
                density = crossing.pdf + sampled.pdf
        found = Contribution()
        if density > 0.0:
            sample.irradiance = wp.min(sample.irradiance / density, BRIGHTEST)
            found = contribution_of(interaction, sample, 1.0)
        bright = luminance(found.color)
        if bright > 0.0 and bright < wp.inf:
            total += bright
            chance = bright / total
            if rest < chance:
                chosen = found
                weight = bright
                rest = rest / chance
            else:
                rest = (rest - chance) / (1.0 - chance)
    if weight > 0.0:
        chosen.color = (total / weight) * chosen.color
    return chosen


@wp.func
def sample_by_lobe(
    number: int, chance: float, interaction: Interaction, u: wp.vec2, which: float, scene: wp.array[ShadingScene]
) -> LightSample:
    """Samples light ``number`` by the highlight, as is done with probability ``chance``; black: it misses the light.

    The balance heuristic weights the irradiance, together with samples by the light (`weight_beside_lobe`).
    """
    sample = LightSample()
    sampled = bsdf_sample(highlight_of(interaction.bsdf), interaction.normal, interaction.wo, u, which)
    if sampled.pdf > 0.0:
        crossing = crossing_of(number, interaction.position, sampled.direction, scene)
        if crossing.pdf > 0.0:
            sample.direction = sampled.direction
            sample.distance = crossing.t
            sample.irradiance = crossing.radiance / ((1.0 - chance) * crossing.pdf + chance * sampled.pdf)
    return sample


@wp.func
def weight_beside_lobe(sample: LightSample, chance: float, interaction: Interaction) -> float:
    """Returns the factor of a sample by a light, which the highlight samples in its place with probability ``chance``.

    It is the weight of the balance heuristic over the probability of the sample by the light, or 1 if that is certain.
    """
    if chance <= 0.0:
        return 1.0
    pdf = bsdf_pdf(highlight_of(interaction.bsdf), interaction.normal, interaction.wo, sample.direction)
    both = (1.0 - chance) * sample.pdf + chance * pdf
    return wp.where(both > 0.0, sample.pdf / both, 0.0)


@wp.func
def sample_light_or_lobe(
    choice: LightChoice, interaction: Interaction, key: wp.uint32, index: int, scene: wp.array[ShadingScene]
) -> Contribution:
    """Samples the selected light, not the environment; the contribution is divided by the selection probability.

    Either the light or, with the probability of ``lobe_chance``, the highlight samples the direction; the balance
    heuristic (Veach and Guibas 1995) for one sample weights both. Emissive triangles are resampled. ``index`` is the
    number of the pixel's sample.
    """
    if choice.number == scene[0].settings[0].light_count:
        resampled = resampled_emitters(interaction, key, index, scene)
        resampled.color = resampled.color / choice.probability
        return resampled
    u = sobol_2d(branch_key(key, POINT_BRANCH), index)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), index)[1]
    chance = lobe_chance(choice.number, interaction, scene)
    sample = LightSample()
    if u[0] < chance:
        sample = sample_by_lobe(choice.number, chance, interaction, wp.vec2(u[0] / chance, u[1]), which, scene)
    else:
        remapped = wp.vec2((u[0] - chance) / (1.0 - chance), u[1])
        sample = sample_of_choice(choice, interaction.position, remapped, which, scene)
        sample.irradiance *= weight_beside_lobe(sample, chance, interaction)
    return contribution_of(interaction, sample, 1.0 / choice.probability)


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
    """Starts shadow ray ``i`` to light ``number`` at surface ``slot`` of ray ``i``: 0 for Gaussians, 1 for a mesh."""
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
    """Samples the light that real-time rendering has selected, and starts shadow ray ``i`` if one is needed.

    No ray is needed if the contribution is black, the frame has no shadows, or the light casts none. ``slot`` is the
    lit surface of ray ``i``: 0 for Gaussians, 1 for a mesh. Shadow ray ``i`` must be inactive before.
    """
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)[1]
    contribution = Contribution()
    if is_environment(choice.number, scene):
        contribution = sample_chosen_environment(choice, interaction, u, which, scene)
    else:
        contribution = sample_light_or_lobe(choice, interaction, key, sample, scene)
    if is_black(contribution.color) or no_shadows or not casts_shadow(choice.number, scene):
        return contribution
    start_chosen_ray(i, slot, choice.number, contribution, scene, wave, rays)
    return contribution
