"""What a path receives at a surface: one sample of one light, and what its own rays meet of lights.

Both reach the environment, triangles that shine and visible lights: each counts by the power heuristic (Veach and
Guibas 1995). The equations are in docs/method/paths.md.
"""

import warp as wp

from lumisplat.device.light.direct_light import contribution_of
from lumisplat.device.light.emitter import area_density, edge_product, emitter_share, sample_emitter
from lumisplat.device.light.environment import environment_density, environment_radiance, sample_environment
from lumisplat.device.light.light import sample_light
from lumisplat.device.light.light_choice import choice_probability, meets_rays
from lumisplat.device.light.visible_light import light_crossing
from lumisplat.device.material.bsdf import bsdf_pdf
from lumisplat.device.material.media import absorption_on_ray, passed
from lumisplat.device.math.color import decode_srgb_color
from lumisplat.device.structs.light import LIGHT_ENVIRONMENT, LightSample
from lumisplat.device.structs.path import LightChoice, PathData, PathVertex
from lumisplat.device.structs.shading import Contribution, Interaction, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.func
def power_heuristic(density: float, other: float) -> float:
    """Weight of a sample of this density, if the direction might have been sampled with the other one as well."""
    if density <= 0.0:
        return 0.0
    ratio = other / density
    return 1.0 / (1.0 + ratio * ratio)


@wp.func
def sampled_light(
    choice: LightChoice,
    branch_share: float,
    interaction: Interaction,
    u: wp.vec2,
    which: float,
    is_met: bool,
    scene: wp.array[ShadingScene],
) -> Contribution:
    """Contribution of the chosen light at an interaction, over the probability of the choice.

    Args:
        choice: The light.
        branch_share: Probability with which the path goes on by the BSDF of this interaction.
        interaction: The surface.
        u: Random, 0..1 each.
        which: Random, 0..1.
        is_met: Whether rays show this light, see ``meets_rays``.
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
    weight = 1.0 / choice.probability
    if is_met and sample.density > 0.0:
        density = bsdf_pdf(interaction.bsdf, interaction.normal, interaction.wo, sample.direction)
        weight *= power_heuristic(choice.probability * sample.density, branch_share * density)
    return contribution_of(interaction, sample, weight)


@wp.func
def vertex_of(i: int, paths: PathData) -> PathVertex:
    """The surface where the ray of path ``i`` begins."""
    vertex = PathVertex()
    vertex.position = paths.position[i]
    vertex.normal = paths.normal[i]
    vertex.importance = paths.importance[i]
    return vertex


@wp.func
def far_light(i: int, direction: wp.vec3, no_shadows: bool, paths: PathData, scene: wp.array[ShadingScene]) -> wp.vec3:
    """Linear radiance that path ``i`` sees infinitely far away, weighted against samples of the environment.

    Without an environment, that is the background, but in mirrors only: it is a picture, and shines on nothing.
    """
    if scene[0].environment.exists == 0:
        if paths.is_specular[i]:
            return decode_srgb_color(scene[0].settings[0].background)
        return wp.vec3(0.0)
    radiance = environment_radiance(scene[0].environment, direction)
    if paths.is_specular[i]:
        return radiance
    density = paths.density[i]
    for number in range(scene[0].settings[0].light_count):
        if scene[0].lights[number].kind == LIGHT_ENVIRONMENT:
            if not meets_rays(number, no_shadows, scene):
                return wp.vec3(0.0)
            if density > 0.0:
                other = choice_probability(number, vertex_of(i, paths), scene)
                other *= environment_density(scene[0].environment, direction)
                radiance *= power_heuristic(density, other)
    return radiance


@wp.func
def emitted_share(
    i: int, no_shadows: bool, paths: PathData, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> float:
    """Weight of the emission of the mesh that the ray of path ``i`` hits, against samples of what shines."""
    density = paths.density[i]
    number = wave[0].meshes.instance[i]
    if paths.is_specular[i] or scene[0].emitters.ends.shape[0] == 0 or scene[0].emitters.first[number] < 0:
        return 1.0
    if no_shadows:
        return 0.0
    if density <= 0.0:
        return 1.0
    face = wave[0].meshes.face[i]
    k = scene[0].emitters.first[number] + face - scene[0].mesh_instances[number].face_first
    across = edge_product(number, scene[0].meshes.indices[face], scene)
    vertex = vertex_of(i, paths)
    way = wave[0].rays.origin[i] + wave[0].meshes.t[i] * wave[0].rays.direction[i] - vertex.position
    other = area_density(emitter_share(k, scene), across, wave[0].rays.direction[i], wp.dot(way, way))
    other *= choice_probability(scene[0].settings[0].light_count, vertex, scene)
    return power_heuristic(density, other)


@wp.func
def light_on_way(
    i: int, end: float, no_shadows: bool, paths: PathData, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Linear radiance of the visible lights that the ray of path ``i`` passes up to ``end``, weighted likewise."""
    total = wp.vec3(0.0)
    density = paths.density[i]
    vertex = vertex_of(i, paths)
    for number in range(scene[0].settings[0].light_count):
        is_shown = paths.is_specular[i] or meets_rays(number, no_shadows, scene)
        if scene[0].lights[number].visible != 0 and is_shown:
            crossing = light_crossing(scene[0].lights[number], wave[0].rays.origin[i], wave[0].rays.direction[i])
            if crossing.t < end:
                share = float(1.0)
                if density > 0.0:
                    share = power_heuristic(density, choice_probability(number, vertex, scene) * crossing.density)
                radiance = crossing.radiance
                if scene[0].settings[0].absorbs != 0:
                    radiance = wp.cw_mul(radiance, passed(absorption_on_ray(i, scene, wave), crossing.t))
                total += share * radiance
    return total
