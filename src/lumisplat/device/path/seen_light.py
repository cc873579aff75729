"""What the rays of paths see of what shines (docs/method/paths.md#lights).

Surfaces sample the environment, triangles that shine and visible lights as well: each counts by the power heuristic.
"""

import warp as wp

from lumisplat.device.light.direct_light import choice_probability, environment_number, meets_rays, power_heuristic
from lumisplat.device.light.emitter import area_density, emitter_share
from lumisplat.device.light.environment import environment_density, environment_radiance
from lumisplat.device.light.light import light_crossing
from lumisplat.device.light.mesh_interaction import mesh_emission
from lumisplat.device.material.media import absorption_on_ray, passed
from lumisplat.device.material.specular_bounce import mesh_coverage
from lumisplat.device.math.color import captured_color, decode_srgb_color
from lumisplat.device.structs.path import LightCrossing, PathData, PathVertex
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.func
def vertex_of(i: int, paths: wp.array[PathData]) -> PathVertex:
    """The surface where the ray of path ``i`` begins."""
    vertex = PathVertex()
    vertex.position = paths[0].position[i]
    vertex.normal = paths[0].normal[i]
    vertex.importance = paths[0].importance[i]
    return vertex


@wp.func
def leaves_receiver(i: int, paths: wp.array[PathData]) -> bool:
    """Whether the ray of path ``i`` leaves a shadow-only surface, whose lights all count by their own samples.

    But for an environment that rays meet: of that, it sees as much as its own set leaves open.
    """
    return paths[0].density[i] < 0.0


@wp.func
def far_light(
    i: int, direction: wp.vec3, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene]
) -> wp.vec3:
    """Linear radiance that path ``i`` sees infinitely far away, weighted against samples of the environment.

    Without an environment, that is the background, but in mirrors only: it is a picture, and shines on nothing.
    """
    if scene[0].environment.exists == 0:
        if paths[0].is_specular[i]:
            return decode_srgb_color(scene[0].settings[0].background)
        return wp.vec3(0.0)
    radiance = environment_radiance(scene[0].environment, direction)
    if paths[0].is_specular[i]:
        return radiance
    number = environment_number(scene)
    if number >= 0:
        if not meets_rays(number, no_shadows, scene):
            return wp.vec3(0.0)
        if paths[0].density[i] > 0.0:
            other = choice_probability(number, vertex_of(i, paths), scene)
            other *= environment_density(scene[0].environment, direction)
            radiance *= power_heuristic(paths[0].density[i], other)
    return radiance


@wp.func
def emitted_share(
    i: int, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> float:
    """Weight of the emission of the mesh that the ray of path ``i`` hits, against samples of what shines."""
    density = paths[0].density[i]
    number = wave[0].meshes.instance[i]
    if paths[0].is_specular[i] or scene[0].emitters.ends.shape[0] == 0 or scene[0].emitters.first[number] < 0:
        return 1.0
    if leaves_receiver(i, paths) or not meets_rays(scene[0].settings[0].light_count, no_shadows, scene):
        return 0.0
    if density <= 0.0:
        return 1.0
    face = wave[0].meshes.face[i]
    k = scene[0].emitters.first[number] + face - scene[0].mesh_instances[number].face_first
    across = scene[0].emitters.triangles[k].across
    vertex = vertex_of(i, paths)
    way = wave[0].rays.origin[i] + wave[0].meshes.t[i] * wave[0].rays.direction[i] - vertex.position
    other = area_density(emitter_share(k, scene), across, wave[0].rays.direction[i], wp.dot(way, way))
    other *= choice_probability(scene[0].settings[0].light_count, vertex, scene)
    return power_heuristic(density, other)


@wp.func
def shown_light(
    i: int,
    number: int,
    no_shadows: bool,
    paths: wp.array[PathData],
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
) -> LightCrossing:
    """Where the ray of path ``i`` meets light ``number``, and its radiance, weighted likewise; inf: it shows none."""
    crossing = LightCrossing()
    crossing.t = wp.inf
    is_shown = not leaves_receiver(i, paths) and (paths[0].is_specular[i] or meets_rays(number, no_shadows, scene))
    if scene[0].lights[number].visible == 0 or not is_shown:
        return crossing
    crossing = light_crossing(scene[0].lights[number], wave[0].rays.origin[i], wave[0].rays.direction[i])
    density = paths[0].density[i]
    if density > 0.0 and crossing.t < wp.inf:
        other = choice_probability(number, vertex_of(i, paths), scene) * crossing.density
        crossing.radiance = power_heuristic(density, other) * crossing.radiance
    if crossing.t < wp.inf and scene[0].settings[0].absorbs != 0:
        crossing.radiance = wp.cw_mul(crossing.radiance, passed(absorption_on_ray(i, scene, wave), crossing.t))
    return crossing


@wp.func
def own_light(
    i: int, no_shadows: bool, paths: wp.array[PathData], scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Linear radiance that path ``i`` sees of captures, and of what meshes shine by themselves."""
    seen = captured_color(wave[0].radiance.captured[i], wave[0].radiance.captured_weight[i])
    if not paths[0].is_specular[i]:
        seen *= scene[0].settings[0].capture_gain
    seen += wave[0].radiance.light[i]
    if wave[0].meshes.face[i] >= 0:
        share = emitted_share(i, no_shadows, paths, scene, wave)
        if share < 1.0:
            reached = wave[0].gaussians.transmittance[i] * mesh_coverage(i, scene, wave)
            seen += (share - 1.0) * reached * mesh_emission(i, scene, wave)
    return seen
