"""What a path receives at a surface by one sample of one light (docs/method/paths.md#lights).

Its own rays meet some lights, too: each of the two counts by the power heuristic (Veach and Guibas 1995).
"""

import warp as wp

from lumisplat.device.light.direct_light import contribution_of
from lumisplat.device.light.emitter import sample_emitter
from lumisplat.device.light.environment import sample_environment
from lumisplat.device.light.light import sample_light
from lumisplat.device.material.bsdf import bsdf_pdf
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT, LightSample
from lumisplat.device.structs.path import LightChoice, SampledLight
from lumisplat.device.structs.shading import Contribution, Interaction, ShadingScene

wp.set_module_options({"enable_backward": False})


@wp.func
def power_heuristic(density: float, other: float) -> float:
    """Weight of a sample of this density, if the direction might have been sampled with the other one as well."""
    if density <= 0.0:
        return 0.0
    ratio = other / density
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def weighted(contribution: Contribution, weight: float) -> SampledLight:
    """A contribution, and what of it counts besides what rays meet."""
    light = SampledLight()
    light.sent = contribution.color
    light.contribution = contribution
    light.contribution.color = weight * contribution.color
    return light


@wp.func
def sampled_light(
    choice: LightChoice,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    is_met: bool,
    scene: wp.array[ShadingScene],
) -> SampledLight:
    """Contribution of the chosen light at an interaction, over the probability of the choice.

    Args:
        choice: The light.
        interaction: The surface.
        u: Random, 0..1 each.
        which: Random, 0..1.
        is_met: Whether rays that the surface scatters show this light, see ``meets_rays``.
        scene: With the lights.
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
    if is_met and sample.density > 0.0:
        density = bsdf_pdf(interaction.bsdf, interaction.normal, interaction.wo, sample.direction)
        weight = power_heuristic(choice.probability * sample.density, density)
    return weighted(contribution_of(interaction, sample, 1.0 / choice.probability), weight)
