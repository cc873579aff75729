"""Reflection and refraction, wave by wave. One item is one ray, or one branch of a ray.

A ray has two branches, numbered ``ray`` (reflected) and ``stride + ray`` (refracted); most are empty. An inclusive sum
over how many there are in each, 0 or 1, numbers the rays of the next wave. The mirror image comes first in it, then
what is seen through glass, each in the order of the wave before: neighbours stay neighbours.
"""

import warp as wp

from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, spawn_point
from lumisplat.device.math.color import captured_color
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.shading import RayRadiance, ShadingScene

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def spawn_rays(
    start: int,
    scene: wp.array(dtype=ShadingScene),
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    path_weights: wp.array(dtype=float),
    branches: wp.array(dtype=int),
    branch_ends: wp.array(dtype=int),
    rays_out: RayData,
    weights_out: wp.array(dtype=wp.vec3),
    path_weights_out: wp.array(dtype=float),
):
    """Item = branch: starts its ray on the surface, on the side on which it goes on."""
    j = start + wp.tid()
    if branches[j] == 0:
        return
    stride = branches.shape[0] // 2
    refracted = j // stride
    i = j % stride
    is_lit = scene[0].settings[0].is_lit != 0
    bounce = bounce_of_ray(i, rays, meshes, scene[0].mesh_instances, scene[0].meshes, is_lit)
    weight = gaussians.transmittance[i] * bounce.reflected
    direction = reflect(rays.direction[i], bounce.normal)
    side = bounce.side
    if refracted == 1:
        weight = gaussians.transmittance[i] * bounce.refracted
        direction = refract(rays.direction[i], bounce.normal, bounce.eta)
        side = -bounce.side
    corners = scene[0].meshes.indices[meshes.face[i]]
    instance = scene[0].mesh_instances[meshes.instance[i]]

    child = branch_ends[j] - 1
    rays_out.is_active[child] = True
    rays_out.origin[child] = spawn_point(instance, scene[0].meshes, corners, hit_weights(meshes.weights[i]), side)
    rays_out.direction[child] = direction
    rays_out.t_min[child] = 0.0
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = rays.path_length[i] + meshes.t[i]
    rays_out.sample_key[child] = branch_key(rays.sample_key[i], refracted)
    rays_out.pixel_key[child] = branch_key(rays.pixel_key[i], refracted)
    weights_out[child] = weight
    path_weights_out[child] = path_weights[i] * wp.max(weight)


@wp.kernel
def gather_branches(
    start: int,
    scene: wp.array(dtype=ShadingScene),
    branches: wp.array(dtype=int),
    branch_ends: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
    seen: RayRadiance,
    radiance_inout: RayRadiance,
):
    """Adds what a ray's branches see to what it sees itself: display-referred colours if unlit, else linear light."""
    i = start + wp.tid()
    stride = branches.shape[0] // 2
    is_lit = scene[0].settings[0].is_lit != 0
    color = wp.vec3(0.0)
    if not is_lit:
        color = radiance_inout.captured[i]
    for branch in range(2):
        j = branch * stride + i
        if branches[j] == 1:
            child = branch_ends[j] - 1
            if is_lit:
                light = captured_color(seen.captured[child], seen.captured_weight[child])
                if seen.capture_factor:
                    light = wp.cw_mul(light, seen.capture_factor[child])
                color += wp.cw_mul(weights[child], light + seen.light[child])
            else:
                color += wp.cw_mul(weights[child], seen.captured[child])
    if is_lit:
        radiance_inout.light[i] += color
        if radiance_inout.reflection:
            radiance_inout.reflection[i] += color
    else:
        radiance_inout.captured[i] = color
