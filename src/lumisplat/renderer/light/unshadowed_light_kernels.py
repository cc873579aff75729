"""Kernels that add lights without shadows to rays. One thread per ray, which interacts with up to two surfaces."""

import warp as wp

from lumisplat.device.light.direct_light import (
    environment_contribution,
    light_center_contribution,
    light_sample_contribution,
)
from lumisplat.device.light.interaction import SHADE_OPTIONS, load_interaction
from lumisplat.device.light.light import LIGHT_ENVIRONMENT
from lumisplat.device.light.light_lanes import (
    LANES,
    LanesStorage,
    clear_lane,
    has_plain_bsdf,
    light_lanes,
    lit_lanes,
    load_lane,
    reflect_lanes,
)
from lumisplat.device.structs.shading import Interaction, ShadingScene, WaveData

wp.set_module_options(SHADE_OPTIONS)


@wp.func
def is_unshadowed(number: int, no_shadows: bool, scene: wp.array[ShadingScene]) -> bool:
    """Returns whether light ``number`` is added without shadows: the light casts none, or ``no_shadows`` is set."""
    return no_shadows or scene[0].lights[number].casts_shadow == 0


@wp.func
def hard_light(interaction: Interaction, no_shadows: bool, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Returns the light that a surface reflects from lights without shadows; lights count as points or directions.

    The environment is not included.
    """
    total = wp.vec3(0.0)
    for number in range(scene[0].settings[0].light_count):
        if is_unshadowed(number, no_shadows, scene) and scene[0].lights[number].kind != LIGHT_ENVIRONMENT:
            total += light_center_contribution(number, interaction, scene).color
    return total


@wp.func
def sampled_light(
    interaction: Interaction, pixel_key: wp.uint32, sample: int, no_shadows: bool, scene: wp.array[ShadingScene]
) -> wp.vec3:
    """Returns the light that a surface reflects from unshadowed lights sampled at random: environment, soft lights."""
    total = wp.vec3(0.0)
    draws = 1 + scene[0].settings[0].more_draws
    share = 1.0 / float(draws)
    for number in range(scene[0].settings[0].light_count):
        if is_unshadowed(number, no_shadows, scene):
            if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
                for draw in range(draws):
                    index = draws * sample + draw
                    total += share * environment_contribution(number, False, interaction, pixel_key, index, scene).color
                    total += share * environment_contribution(number, True, interaction, pixel_key, index, scene).color
            elif scene[0].settings[0].soft != 0:
                total += light_sample_contribution(number, interaction, pixel_key, sample, scene).color
    return total


@wp.kernel
def add_hard_lights(
    start: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave_inout: wp.array[WaveData],
):
    """Per ray: adds all lights without shadows as points or directions; the environment is not included.

    If this kernel and ``add_sampled_lights`` were one, frames that have only direct light would take an eighth longer.
    """
    i = start + wp.tid()
    stride = wave_inout[0].interactions.exists.shape[0] // 2
    for slot in range(2):
        j = slot * stride + i
        if wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_catcher[j]:
            wave_inout[0].radiance.light[i] += hard_light(load_interaction(j, wave_inout), no_shadows, scene)


@wp.kernel
def add_sampled_lights(
    start: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave_inout: wp.array[WaveData],
):
    """Per ray: adds the unshadowed lights that are sampled at random: the environment, and soft lights."""
    i = start + wp.tid()
    stride = wave_inout[0].interactions.exists.shape[0] // 2
    for slot in range(2):
        j = slot * stride + i
        if wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_catcher[j]:
            interaction = load_interaction(j, wave_inout)
            wave_inout[0].radiance.light[i] += sampled_light(
                interaction, wave_inout[0].rays.pixel_key[i], wave_inout[0].rays.sample[i], no_shadows, scene
            )


BY_LANES = wp.get_module(f"{__name__}.lanes")
# Loops over lanes must stay loops for the vectoriser.
wp.set_module_options(SHADE_OPTIONS | {"max_unroll": 4}, BY_LANES)


@wp.kernel(module=BY_LANES)
def add_hard_lights_lanes(
    start: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave_inout: wp.array[WaveData],
):
    """Per 16 rays: adds the light that ``add_hard_lights`` adds to each of them."""
    first = LANES * (start + wp.tid())
    stride = wave_inout[0].interactions.exists.shape[0] // 2
    storage = LanesStorage()
    lanes = lit_lanes(storage)
    for slot in range(2):
        count = int(0)
        for lane in range(LANES):
            clear_lane(lanes, lane)
            i = first + lane
            j = slot * stride + i
            if i < stride and wave_inout[0].interactions.exists[j] and not wave_inout[0].interactions.shadow_catcher[j]:
                if has_plain_bsdf(j, wave_inout):
                    load_lane(lanes, lane, j, wave_inout)
                    count += 1
                else:
                    wave_inout[0].radiance.light[i] += hard_light(load_interaction(j, wave_inout), no_shadows, scene)
        if count > 0:
            for number in range(scene[0].settings[0].light_count):
                if is_unshadowed(number, no_shadows, scene) and scene[0].lights[number].kind != LIGHT_ENVIRONMENT:
                    light_lanes(scene[0].lights[number], lanes)
                    reflect_lanes(lanes)
            for lane in range(LANES):
                if lanes.weight[lane] > 0.0:
                    total = wp.vec3(lanes.reflected[0, lane], lanes.reflected[1, lane], lanes.reflected[2, lane])
                    wave_inout[0].radiance.light[first + lane] += total
