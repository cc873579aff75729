"""Shadow rays of paths: to the lights that they sample, and to those that their rays show behind blended Gaussians.

The equations are in docs/method/paths.md#lights.
"""

import warp as wp

from lumisplat.device.light.direct_light import (
    CHOICE_BRANCH,
    POINT_BRANCH,
    casts_shadow,
    chosen_light,
    environment_number,
    meets_rays,
    sample_chosen,
    start_chosen_ray,
)
from lumisplat.device.material.bsdf import diffuse_share
from lumisplat.device.material.media import absorption_in, passed, scattered_media
from lumisplat.device.math.color import is_black
from lumisplat.device.math.random import branch_key, draw, sobol_2d
from lumisplat.device.path.images import add_first_light, add_light, add_sent_light
from lumisplat.device.path.seen_light import shown_light
from lumisplat.device.structs.path import BRANCH_MESH, PathData, PathImages, PathShadowRays, PathVertex
from lumisplat.device.structs.shading import Interaction, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

SHOWN_BRANCH = wp.constant(4)
"""Branch of a ray's key: how Gaussians hide a light that the ray itself shows. See also light/direct_light.py."""


@wp.func
def diffuse_of(i: int, number: int, paths: wp.array[PathData]) -> wp.vec3:
    """Share of what path ``i`` brings that its first surface has scattered diffusely."""
    if number == 0 or not paths[0].diffuse:
        return wp.vec3(0.0)
    return paths[0].diffuse[i]


@wp.func
def clear_shadow_ray(j: int, shadows: wp.array[PathShadowRays]):
    """Shadow ray ``j``: there is none, and nothing to be shadowed."""
    shadows[0].contributions[j] = wp.vec3(0.0)
    shadows[0].rays.is_active[j] = False
    shadows[0].opaque[j] = True
    shadows[0].skips[j] = False
    if shadows[0].media:
        shadows[0].media[j] = wp.vec4i(0)


@wp.func
def start_shown_ray(
    i: int, light: int, t: float, value: wp.vec3, wave: wp.array[WaveData], shadows: wp.array[PathShadowRays]
):
    """Starts the shadow ray along ray ``i``, up to a light that it shows at distance ``t``."""
    j = wave[0].rays.is_active.shape[0] + i
    shadows[0].contributions[j] = value
    shadows[0].lights[j] = light
    shadows[0].rays.is_active[j] = True
    shadows[0].rays.origin[j] = wave[0].rays.origin[i]
    shadows[0].rays.direction[j] = wave[0].rays.direction[i]
    shadows[0].rays.t_min[j] = wave[0].rays.t_min[i]
    shadows[0].rays.normal[j] = wave[0].rays.normal[i]
    shadows[0].rays.t_max[j] = t
    shadows[0].rays.path_length[j] = 0.0
    shadows[0].rays.spread[j] = 0.0
    shadows[0].rays.pixel_key[j] = branch_key(wave[0].rays.pixel_key[i], SHOWN_BRANCH)
    shadows[0].rays.sample_key[j] = branch_key(wave[0].rays.sample_key[i], SHOWN_BRANCH)
    shadows[0].rays.sample[j] = wave[0].rays.sample[i]


@wp.func
def add_shown_lights(
    i: int,
    number: int,
    no_shadows: bool,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    paths: wp.array[PathData],
    shadows: wp.array[PathShadowRays],
    images: wp.array[PathImages],
):
    """Adds the visible lights that the ray of path ``i`` passes before its surface.

    Behind Gaussians that are blended, a shadow ray says how much of one of them there is.
    """
    is_hazy = shadows[0].contributions.shape[0] > wave[0].rays.is_active.shape[0]
    end = wp.min(wave[0].meshes.t[i], wave[0].gaussians.depth[i])
    key = branch_key(wave[0].rays.sample_key[i], SHOWN_BRANCH)
    met = int(0)
    for light in range(scene[0].settings[0].light_count):
        crossing = shown_light(i, light, no_shadows, paths, scene, wave)
        value = wp.cw_mul(paths[0].throughput[i], crossing.radiance)
        if number == 0 and crossing.t < end:
            wave[0].radiance.alpha[i] = 1.0
        if is_hazy and crossing.t < wp.inf:
            met += 1
            if draw(key, wp.uint32(light)) * float(met) < 1.0:
                start_shown_ray(i, light, crossing.t, value, wave, shadows)
        elif crossing.t < end:
            add_light(
                paths[0].root[i],
                paths[0].receives[i],
                value,
                number,
                light,
                scene[0].settings[0].light_count,
                diffuse_of(i, number, paths),
                images,
            )
    if met > 1:
        j = wave[0].rays.is_active.shape[0] + i
        shadows[0].contributions[j] = float(met) * shadows[0].contributions[j]


@wp.func
def light_surface(
    i: int,
    slot: int,
    factor: wp.vec3,
    no_shadows: bool,
    interaction: Interaction,
    vertex: PathVertex,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    shadows: wp.array[PathShadowRays],
):
    """Samples one light for the surface by which path ``i`` goes on, and starts its shadow ray.

    Args:
        i: Ray of the path.
        slot: Which of its two interactions: 0, Gaussians, or 1, a mesh.
        factor: Throughput of the path by that surface.
        no_shadows: Light passes through everything.
        interaction: With the surface.
        vertex: The same.
        scene: The scene.
        wave: Of the ray.
        shadows: Receives contribution and shadow ray.
    """
    key = wave[0].rays.pixel_key[i]
    sample = wave[0].rays.sample[i]
    u = sobol_2d(branch_key(key, POINT_BRANCH), sample)
    which = sobol_2d(branch_key(key, CHOICE_BRANCH), sample)
    choice = chosen_light(which[0], vertex, scene)
    if choice.number < 0:
        return
    is_met = meets_rays(choice.number, no_shadows, scene)
    shadows[0].opaque[i] = is_met
    if interaction.shadow_only:
        # Rays that leave it show of all lights only the environment, which they alone find.
        if is_met and choice.number == environment_number(scene):
            return
        shadows[0].skips[i] = True
        is_met = False
    light = sample_chosen(choice, interaction, u, which[1], is_met, scene)
    shadows[0].contributions[i] = wp.cw_mul(factor, light.contribution.color)
    direction = light.contribution.direction
    reaching = wp.cw_mul(factor, light.sent)
    if shadows[0].sent:
        shadows[0].sent[i] = reaching
    if shadows[0].media:
        media = scattered_media(i, slot == BRANCH_MESH, direction, interaction.normal, scene, wave)
        if is_met:  # Glass blocks this way, so that all of it is in one medium.
            share = passed(absorption_in(media, scene[0].mesh_instances), light.contribution.distance)
            shadows[0].contributions[i] = wp.cw_mul(shadows[0].contributions[i], share)
            reaching = wp.cw_mul(reaching, share)
        else:
            shadows[0].media[i] = media
    shadows[0].lights[i] = choice.number
    if shadows[0].diffuse:
        shadows[0].diffuse[i] = diffuse_share(interaction.bsdf, interaction.normal, interaction.wo, direction)
    if shadows[0].reaching:
        shadows[0].reaching[i] = reaching
    if is_black(shadows[0].contributions[i]) or no_shadows or not casts_shadow(choice.number, scene):
        return
    start_chosen_ray(i, slot, choice.number, light.contribution, scene, wave, shadows[0].rays)


@wp.func
def add_sent(
    i: int,
    number: int,
    visible: wp.vec3,
    scene: wp.array[ShadingScene],
    paths: wp.array[PathData],
    shadows: wp.array[PathShadowRays],
    images: wp.array[PathImages],
):
    """Adds samples of lights: to a shadow-only surface unshadowed, as captured, or to the lights' own layers.

    Args:
        i: Ray of the path.
        number: Of its wave.
        visible: Share of the light that the shadow ray lets through.
        scene: With the lights.
        paths: Those of the wave.
        shadows: Has the samples.
        images: Where they are added.
    """
    light = shadows[0].lights[i]
    if shadows[0].skips[i]:
        if light < scene[0].settings[0].light_count:
            add_sent_light(paths[0].root[i], shadows[0].contributions[i], images)
    elif number == 0 and shadows[0].sent:
        arrived = wp.cw_mul(shadows[0].reaching[i], visible)
        add_first_light(paths[0].root[i], shadows[0].sent[i], arrived, light, images)
