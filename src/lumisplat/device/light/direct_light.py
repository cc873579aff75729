"""Direct light at interactions: unshadowed contributions of lights to a ray's radiance (docs/method/lighting.md)."""

import warp as wp

from lumisplat.device.light.environment import environment_density, environment_radiance, sample_environment
from lumisplat.device.light.light import sample_light
from lumisplat.device.material.bsdf import bsdf_eval, bsdf_pdf, bsdf_sample
from lumisplat.device.material.rough_glass import transmits
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, sobol_2d
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT, Bsdf, LightSample
from lumisplat.device.structs.shading import Contribution, Interaction, ShadingScene

wp.set_module_options({"enable_backward": False})

LIGHT_BRANCHES = wp.constant(2)
"""First branch of the lights' random numbers: 0 and 1 are the reflected and the refracted ray."""

SHADOW_BRANCHES = wp.constant(2)
"""First branch of a light's shadow rays: 0 and 1 are samples of the BSDF."""


@wp.func
def arrives(interaction: Interaction, direction: wp.vec3) -> bool:
    """Whether light from there arrives at an interaction: from above, or, at rough glass, from below."""
    cosine = wp.dot(interaction.normal, direction)
    above = wp.dot(interaction.horizon_normal, direction)
    if cosine < 0.0 and above < 0.0:
        return transmits(interaction.bsdf)
    return cosine > 0.0 and above > 0.0


@wp.func
def irradiance_of(interaction: Interaction, sample: LightSample) -> wp.vec3:
    """Unshadowed irradiance at an interaction by a sample of a light."""
    if not arrives(interaction, sample.direction):
        return wp.vec3(0.0)
    return wp.abs(wp.dot(interaction.normal, sample.direction)) * sample.irradiance


@wp.func
def contribution_of(interaction: Interaction, sample: LightSample, share: float) -> Contribution:
    """Contribution of ``share`` of a light sample to the ray's radiance; of a shadow-only surface, its irradiance."""
    irradiance = share * irradiance_of(interaction, sample)
    result = Contribution()
    if is_black(irradiance):
        return result
    result.direction = sample.direction
    result.distance = sample.distance
    result.color = irradiance
    if not interaction.shadow_only:
        reflectance = bsdf_eval(interaction.bsdf, interaction.normal, interaction.wo, sample.direction)
        result.color = interaction.weight * wp.cw_mul(reflectance, irradiance)
    return result


@wp.func
def light_key(pixel_key: wp.uint32, number: int) -> wp.uint32:
    """Key of the random sequence that samples light ``number``."""
    return branch_key(pixel_key, LIGHT_BRANCHES + number)


@wp.func
def shadow_ray_key(key: wp.uint32, number: int, samples_bsdf: bool, slot: int) -> wp.uint32:
    """Key of the shadow ray from interaction ``slot`` of a ray of this key towards light ``number``."""
    return branch_key(light_key(key, number), SHADOW_BRANCHES + slot + 2 * int(samples_bsdf))


@wp.func
def light_center_contribution(number: int, interaction: Interaction, scene: wp.array[ShadingScene]) -> Contribution:
    """Contribution of light ``number``, not the environment, sampled at its centre."""
    sample = sample_light(scene[0].lights[number], interaction.position, 0, wp.vec2(0.5))
    return contribution_of(interaction, sample, 1.0)


@wp.func
def light_sample_contribution(
    number: int, interaction: Interaction, pixel_key: wp.uint32, index: int, scene: wp.array[ShadingScene]
) -> Contribution:
    """Contribution of light ``number``, not the environment, sampled at a random point of its extent.

    Args:
        number: Of the light.
        interaction: What it lights.
        pixel_key: Of the ray.
        index: Number of the ray's sample.
        scene: The scene.
    """
    u = sobol_2d(light_key(pixel_key, number), index)
    sample = sample_light(scene[0].lights[number], interaction.position, 1, u)
    return contribution_of(interaction, sample, 1.0)


@wp.func
def environment_sample(
    samples_bsdf: bool,
    bsdf: Bsdf,
    interaction: Interaction,
    u: wp.vec2,
    choice: float,
    scene: wp.array[ShadingScene],
) -> LightSample:
    """One of two samples of the environment, of its radiance or of a BSDF.

    The balance heuristic (Veach and Guibas 1995) makes the sum of both samples an unbiased estimate.

    Args:
        samples_bsdf: Which of the two.
        bsdf: Of the surface, or a part of it.
        interaction: The surface.
        u: Random, 0..1 each.
        choice: Random, 0..1, decides between the parts of the material.
        scene: The scene.
    """
    sample = LightSample()
    environment = scene[0].environment
    if samples_bsdf:
        sampled = bsdf_sample(bsdf, interaction.normal, interaction.wo, u, choice)
        sample.direction = sampled.direction
        sample.distance = wp.inf
        if sampled.density > 0.0:
            both = sampled.density + environment_density(environment, sampled.direction)
            sample.irradiance = environment_radiance(environment, sampled.direction) / both
    else:
        sample = sample_environment(environment, u)
        if sample.density > 0.0:
            other = bsdf_pdf(bsdf, interaction.normal, interaction.wo, sample.direction)
            sample.irradiance = sample.irradiance * (sample.density / (sample.density + other))
    return sample


@wp.func
def environment_contribution(
    number: int,
    samples_bsdf: bool,
    interaction: Interaction,
    pixel_key: wp.uint32,
    index: int,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Contribution of the environment, light ``number``, by one of its two samples."""
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
    """Contribution of light ``number`` for a shadow ray.

    Of the environment by one of its two samples; of others by a random point for soft shadows, by the centre for hard
    ones.
    """
    contribution = Contribution()
    if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
        contribution = environment_contribution(number, samples_bsdf, interaction, pixel_key, index, scene)
    elif scene[0].settings[0].soft != 0:
        contribution = light_sample_contribution(number, interaction, pixel_key, index, scene)
    else:
        contribution = light_center_contribution(number, interaction, scene)
    return contribution
