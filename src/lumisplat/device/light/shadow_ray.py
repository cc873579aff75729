"""How shadow rays leave the interactions of a wave."""

import warp as wp

from lumisplat.device.light.shadow_terminator import lift_of, lifted
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Contribution, ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.func
def spawn_lift(j: int, direction: wp.vec3, wave: wp.array[WaveData]) -> wp.vec3:
    """From the spawn point of interaction ``j`` to where a ray begins: on the smooth surface, where that is above."""
    height = wave[0].interactions.smooth_height[j]
    if height <= 0.0:
        return wp.vec3(0.0)
    normal = wave[0].interactions.horizon_normal[j]
    return lift_of(height, normal, wave[0].interactions.geometric_normal[j], direction)


@wp.func
def start_shadow_ray(
    j: int,
    number: int,
    contribution: Contribution,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
):
    """Starts shadow ray ``j``, from interaction ``j`` towards light ``number``; its keys are left to the caller."""
    lift = spawn_lift(j, contribution.direction, wave)
    if wave[0].interactions.smooth_height[j] > 0.0:
        contribution = lifted(contribution, lift)
    rays_out.is_active[j] = True
    rays_out.origin[j] = wave[0].interactions.spawn_point[j] + lift
    rays_out.direction[j] = contribution.direction
    rays_out.t_min[j] = wave[0].interactions.spawn_t_min[j]
    rays_out.t_max[j] = contribution.distance
    if number < scene[0].settings[0].light_count:  # else it is one of triangles that shine
        rays_out.t_max[j] = wp.min(contribution.distance, scene[0].lights[number].range)
    rays_out.path_length[j] = 0.0
    rays_out.spread[j] = 0.0
