"""How rays go on at smooth surfaces that leave surfaces in real time: straight through glass, or mirrored.

The samples of lights pass glass straight on, too, so that rays which it lets through do not count them again. Mirrors
block these samples: what shines by a mirror is seen by rays alone (docs/method/realtime.md#rays).
"""

import warp as wp

from lumisplat.constants.realtime import MIRRORED_SOLID_ANGLE
from lumisplat.device.light.direct_light import environment_number, light_importance, meets_rays
from lumisplat.device.light.environment import environment_radiance
from lumisplat.device.light.light import light_crossing
from lumisplat.device.light.mesh_interaction import mesh_emission
from lumisplat.device.material.fresnel import reflect
from lumisplat.device.material.media import boundary_of_ray
from lumisplat.device.material.specular_bounce import bounce_across, sends_rays_on, spawn_point
from lumisplat.device.math.color import luminance
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.path import BRANCH_REFLECTED, Branch, PathStep
from lumisplat.device.structs.rays import Bounce, RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})

SMALLEST = wp.constant(wp.float32(MIRRORED_SOLID_ANGLE))


@wp.func
def straight_bounce(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> Bounce:
    """Reflection by the mesh that ray ``i`` hits, and what passes it straight on; none, if that is not smooth.

    As for shadow rays, both sides count as air: what leaves glass is mirrored as what enters it.
    """
    bounce = Bounce()
    if wave[0].meshes.face[i] >= 0 and wave[0].gaussians.transmittance[i] > 0.0:
        if sends_rays_on(i, scene, wave):
            boundary = boundary_of_ray(i, scene, wave)
            boundary.eta = 1.0 / scene[0].mesh_instances[wave[0].meshes.instance[i]].material.ior
            bounce = bounce_across(i, boundary, True, scene, wave)
    return bounce


@wp.func
def straight_step(
    i: int, branch: Branch, bounce: Bounce, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> PathStep:
    """How ray ``i`` goes on, if it is reflected or passes; the weight is over the probability of this branch."""
    step = PathStep()
    side = -bounce.side
    step.direction = wave[0].rays.direction[i]
    step.weight = bounce.refracted
    step.media = bounce.media_behind
    if branch.kind == BRANCH_REFLECTED:
        side = bounce.side
        step.direction = reflect(wave[0].rays.direction[i], bounce.normal)
        step.weight = bounce.reflected
        step.media = bounce.media
    step.weight *= wave[0].gaussians.transmittance[i] / branch.probability
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]
    step.origin = spawn_point(instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side)
    return step


@wp.func
def start_onward(i: int, kind: int, step: PathStep, wave: wp.array[WaveData], rays_out: RayData):
    """Starts the ray with which ray ``i`` goes on; the two may have the same arrays."""
    sample_key = branch_key(wave[0].rays.sample_key[i], kind)
    pixel_key = branch_key(wave[0].rays.pixel_key[i], kind)
    sample = wave[0].rays.sample[i]
    rays_out.is_active[i] = True
    rays_out.origin[i] = step.origin
    rays_out.direction[i] = step.direction
    rays_out.t_min[i] = 0.0
    rays_out.normal[i] = wp.vec3(0.0)
    rays_out.t_max[i] = wp.inf
    rays_out.path_length[i] = 0.0
    rays_out.spread[i] = 0.0
    rays_out.sample_key[i] = sample_key
    rays_out.pixel_key[i] = pixel_key
    rays_out.sample[i] = sample


@wp.func
def at_most(radiance: wp.vec3, most: float) -> wp.vec3:
    """A radiance, darkened where its luminance is above a bound."""
    brightness = luminance(radiance)
    if brightness > most:
        return (most / brightness) * radiance
    return radiance


@wp.func
def mirrored_light(
    i: int, way: float, no_shadows: bool, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Linear radiance of lights that paths meet, too, of ray ``i`` that a mirror has reflected.

    What is small and bright is met seldom: it counts as if it was as wide as ``MIRRORED_SOLID_ANGLE``, no brighter.

    Args:
        i: The ray.
        way: Its length before, scene units.
        no_shadows: Samples of lights pass mirrors.
        scene: With the lights.
        wave: Of the ray.
    """
    origin = wave[0].rays.origin[i]
    direction = wave[0].rays.direction[i]
    end = wave[0].meshes.t[i]
    total = wp.vec3(0.0)
    count = scene[0].settings[0].light_count
    if wave[0].meshes.face[i] < 0:
        number = environment_number(scene)
        if number >= 0:
            if meets_rays(number, no_shadows, scene):
                most = light_importance(number, origin, direction, scene) / SMALLEST
                total += at_most(environment_radiance(scene[0].environment, direction), most)
    elif scene[0].emitters.ends.shape[0] > 0 and meets_rays(count, no_shadows, scene):
        if scene[0].emitters.first[wave[0].meshes.instance[i]] >= 0:
            start = origin - way * direction  # as far from the light as where the ray left a surface
            total += at_most(mesh_emission(i, scene, wave), light_importance(count, start, direction, scene) / SMALLEST)
    for number in range(count):
        if scene[0].lights[number].visible != 0 and meets_rays(number, no_shadows, scene):
            crossing = light_crossing(scene[0].lights[number], origin, direction)
            if crossing.t < end:
                total += crossing.radiance / wp.max(1.0, crossing.density * SMALLEST)
    return wave[0].gaussians.transmittance[i] * total
