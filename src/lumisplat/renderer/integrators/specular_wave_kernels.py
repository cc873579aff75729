"""Reflection and refraction, wave by wave. One item is one ray, or one branch of a ray.

A ray has two branches, numbered ``ray`` (reflected) and ``stride + ray`` (refracted); most are empty. An inclusive sum
over how many there are in each, 0 or 1, numbers the rays of the next wave. Reflected rays come first in it, then
refracted ones, each in the order of the wave before: neighbours stay neighbours.
"""

import warp as wp

from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, spawn_point
from lumisplat.device.math.color import captured_color
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def spawn_rays(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
    weights_out: wp.array[wp.vec3],
    path_weights_out: wp.array[float],
    media_out: wp.array[wp.vec4i],
):
    """Item = branch: starts its ray at the surface, on the side to which it leaves."""
    j = start + wp.tid()
    if wave[0].branches[j] == 0:
        return
    stride = wave[0].branches.shape[0] // 2
    refracted = j // stride
    i = j % stride
    is_lit = scene[0].settings[0].is_lit != 0
    bounce = bounce_of_ray(i, is_lit, scene, wave)
    weight = wave[0].gaussians.transmittance[i] * bounce.reflected
    direction = reflect(wave[0].rays.direction[i], bounce.normal)
    side = bounce.side
    media = bounce.media
    if refracted == 1:
        weight = wave[0].gaussians.transmittance[i] * bounce.refracted
        direction = refract(wave[0].rays.direction[i], bounce.normal, bounce.eta)
        side = -bounce.side
        media = bounce.media_behind
    corners = scene[0].meshes.indices[wave[0].meshes.face[i]]
    instance = scene[0].mesh_instances[wave[0].meshes.instance[i]]

    child = wave[0].branch_ends[j] - 1
    rays_out.is_active[child] = True
    rays_out.origin[child] = spawn_point(
        instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side
    )
    rays_out.direction[child] = direction
    rays_out.t_min[child] = 0.0
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = wave[0].rays.path_length[i] + wave[0].meshes.t[i]
    rays_out.spread[child] = wave[0].rays.spread[i]
    rays_out.sample_key[child] = branch_key(wave[0].rays.sample_key[i], refracted)
    rays_out.pixel_key[child] = branch_key(wave[0].rays.pixel_key[i], refracted)
    rays_out.sample[child] = wave[0].rays.sample[i]
    weights_out[child] = weight
    path_weights_out[child] = wave[0].path_weights[i] * wp.max(weight)
    if media_out:
        media_out[child] = media


@wp.kernel
def gather_branches(
    start: int,
    scene: wp.array[ShadingScene],
    far: wp.array[WaveData],
    near_inout: wp.array[WaveData],
):
    """Adds the radiance of a ray's branches to its own: display-referred colours if unlit, else linear light."""
    i = start + wp.tid()
    stride = near_inout[0].branches.shape[0] // 2
    is_lit = scene[0].settings[0].is_lit != 0
    color = wp.vec3(0.0)
    if not is_lit:
        color = near_inout[0].radiance.captured[i]
    for branch in range(2):
        j = branch * stride + i
        if near_inout[0].branches[j] == 1:
            child = near_inout[0].branch_ends[j] - 1
            if is_lit:
                light = captured_color(far[0].radiance.captured[child], far[0].radiance.captured_weight[child])
                if far[0].radiance.capture_factor:
                    light = wp.cw_mul(light, far[0].radiance.capture_factor[child])
                color += wp.cw_mul(far[0].weights[child], light + far[0].radiance.light[child])
            else:
                color += wp.cw_mul(far[0].weights[child], far[0].radiance.captured[child])
    if is_lit:
        near_inout[0].radiance.light[i] += color
        if near_inout[0].radiance.reflection:
            near_inout[0].radiance.reflection[i] += color
    else:
        near_inout[0].radiance.captured[i] = color
