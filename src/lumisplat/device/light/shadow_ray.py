"""How shadow rays leave the interactions of a wave."""

import warp as wp

from lumisplat.device.light.mesh_interaction import mesh_spawn_point
from lumisplat.device.light.shadow_terminator import lift_of, seen_from_above
from lumisplat.device.math.color import is_black
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Contribution, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.func
def leaves_below(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> bool:
    """Whether a ray from interaction ``j`` leaves through its surface."""
    if not wave[0].interactions.transmitted:
        return False
    through = wp.dot(direction, wave[0].interactions.geometric_normal[j]) < 0.0
    return through and not is_black(wave[0].interactions.transmitted[j])


@wp.func
def spawn_origin(
    j: int, direction: wp.vec3, lift: wp.vec3, scene: wp.array[ShadingScene], wave: wp.array[WaveData]
) -> wp.vec3:
    """Where a ray from interaction ``j`` begins, on the side to which it leaves; ``lift`` as ``spawn_lift``."""
    if leaves_below(j, direction, wave):
        stride = wave[0].interactions.exists.shape[0] // 2
        return mesh_spawn_point(j - stride, -wave[0].interactions.geometric_normal[j], scene, wave)
    return wave[0].interactions.spawn_point[j] + lift


@wp.func
def spawn_lift(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> wp.vec3:
    """From the spawn point of interaction ``j`` to where a ray begins: on the smooth surface, where that is above."""
    height = wave[0].interactions.smooth_height[j]
    if height <= 0.0 or leaves_below(j, direction, wave):
        return wp.vec3(0.0)
    normal = wave[0].interactions.horizon_normal[j]
    return lift_of(height, normal, wave[0].interactions.geometric_normal[j], direction)


@wp.func
def start_shadow_ray(
    ray: int,
    j: int,
    number: int,
    contribution: Contribution,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
):
    """Starts a shadow ray from interaction ``j`` towards light ``number``; its keys are left to the caller."""
    origin = spawn_origin(j, contribution.direction, spawn_lift(j, contribution.direction, wave), scene, wave)
    contribution = seen_from_above(contribution, origin - wave[0].interactions.position[j])
    rays_out.is_active[ray] = True
    rays_out.origin[ray] = origin
    rays_out.direction[ray] = contribution.direction
    rays_out.t_min[ray] = wave[0].interactions.spawn_t_min[j]
    rays_out.normal[ray] = wave[0].interactions.geometric_normal[j]
    rays_out.t_max[ray] = contribution.distance
    if number < scene[0].settings[0].light_count:  # else it is one of triangles that shine
        rays_out.t_max[ray] = wp.min(contribution.distance, scene[0].lights[number].range)
    rays_out.path_length[ray] = 0.0
    rays_out.spread[ray] = 0.0
