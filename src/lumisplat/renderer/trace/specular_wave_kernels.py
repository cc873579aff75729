"""Kernels of reflection and refraction, bounce by bounce. One thread per ray, or per branch of a ray.

A wave is all rays after the same number of bounces. A ray has two branches, with indices ``ray`` (reflected) and
``stride + ray`` (refracted). Frames with glossy reflections have a third branch, ``2 stride + ray`` (sampled from a
specular lobe). Most branches are empty. An inclusive prefix sum over the branch counts, 0 or 1, gives the indices of
the next wave's rays: reflected rays first, then refracted rays, then lobe rays, each in the order of the previous wave,
so that neighbours stay neighbours.
"""

import warp as wp

from lumisplat.device.light.glossy_lobe import LOBE_BRANCH, lobe_ray
from lumisplat.device.light.splat_surface import sees_environment, straight_factor
from lumisplat.device.material.media import media_of_ray
from lumisplat.device.material.microfacets import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, spawn_point
from lumisplat.device.math.color import captured_color, is_black
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


LOBES = wp.constant(2)
"""Index of the branch sampled from the specular lobe, after reflection (0) and refraction (1)."""


@wp.func
def start_ray(child: int, parent: int, branch: int, path_length: float, wave: wp.array[WaveData], rays_out: RayData):
    """Starts ray ``child``, a branch of ray ``parent``; the caller sets origin, direction, ``t_min`` and footprint.

    Args:
        child: Index of the new ray in the next wave.
        parent: Index of the parent ray in this wave.
        branch: Number that derives the child's random keys from the parent's.
        path_length: Length of the unfolded path from the eye to the child's origin.
        wave: Wave of the parent.
        rays_out: Rays of the next wave.
    """
    rays_out.is_active[child] = True
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = path_length
    rays_out.sample_key[child] = branch_key(wave[0].rays.sample_key[parent], branch)
    rays_out.pixel_key[child] = branch_key(wave[0].rays.pixel_key[parent], branch)
    rays_out.sample[child] = wave[0].rays.sample[parent]


@wp.func
def spawn_lobe_ray(
    i: int,
    child: int,
    wave: wp.array[WaveData],
    rays_out: RayData,
    weights_out: wp.array[wp.vec3],
    path_weights_out: wp.array[float],
    media_out: wp.array[wp.vec4i],
    sees_environment_out: wp.array[wp.bool],
):
    """Starts a ray sampled from the specular lobe at the hit of ray ``i``; its weight is 0 below the horizon."""
    lobe = lobe_ray(i, wave)
    # Scattered rays have no footprint: their length to the eye does not count.
    start_ray(child, i, LOBE_BRANCH, 0.0, wave, rays_out)
    rays_out.is_active[child] = not is_black(lobe.weight)
    rays_out.origin[child] = lobe.origin
    rays_out.direction[child] = lobe.direction
    rays_out.t_min[child] = lobe.t_min
    rays_out.normal[child] = lobe.normal
    rays_out.spread[child] = 0.0
    weights_out[child] = lobe.weight
    path_weights_out[child] = wave[0].path_weights[i] * wp.max(lobe.weight)
    sees_environment_out[child] = False
    if media_out:
        media_out[child] = media_of_ray(i, wave)


@wp.kernel
def spawn_rays(
    start: int,
    scene: wp.array[ShadingScene],
    wave: wp.array[WaveData],
    rays_out: RayData,
    weights_out: wp.array[wp.vec3],
    path_weights_out: wp.array[float],
    media_out: wp.array[wp.vec4i],
    sees_environment_out: wp.array[wp.bool],
):
    """Per branch: starts its ray at the parent's hit, on the side of the surface where the new ray runs.

    Rays beyond the capacity of ``rays_out`` are left out; the sample is then drawn again (`SpecularWaves.finish`).
    ``media_out`` is empty in scenes without media, and ``sees_environment_out`` where all rays get environment
    radiance.
    """
    j = start + wp.tid()
    if wave[0].branches[j] == 0:
        return
    stride = wave[0].path_weights.shape[0]
    refracted = j // stride
    i = j % stride
    child = wave[0].branch_ends[j] - 1
    if child >= rays_out.is_active.shape[0]:
        return
    if refracted == 2:
        spawn_lobe_ray(i, child, wave, rays_out, weights_out, path_weights_out, media_out, sees_environment_out)
        return
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

    start_ray(child, i, refracted, wave[0].rays.path_length[i] + wave[0].meshes.t[i], wave, rays_out)
    rays_out.origin[child] = spawn_point(
        instance, scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i]), side
    )
    rays_out.direction[child] = direction
    rays_out.t_min[child] = 0.0
    rays_out.normal[child] = wp.vec3(0.0)
    rays_out.spread[child] = wave[0].rays.spread[i]
    weights_out[child] = weight
    path_weights_out[child] = wave[0].path_weights[i] * wp.max(weight)
    if media_out:
        media_out[child] = media
    if sees_environment_out:
        # Surfaces that shadow rays pass, such as glass, do not hide environment light, which was added as direct light.
        sees_environment_out[child] = refracted == 0 or sees_environment(i, wave)


@wp.kernel
def gather_branches(
    start: int,
    scene: wp.array[ShadingScene],
    far: wp.array[WaveData],
    near_inout: wp.array[WaveData],
):
    """Per ray: adds the radiance of its reflected, refracted and lobe rays (in wave ``far``) to its own radiance.

    Display-referred colours are added if unlit, else linear radiance.
    """
    i = start + wp.tid()
    stride = near_inout[0].path_weights.shape[0]
    is_lit = scene[0].settings[0].is_lit != 0
    color = wp.vec3(0.0)
    if not is_lit:
        color = near_inout[0].radiance.captured[i]
    for branch in range(near_inout[0].branches.shape[0] // stride):
        j = branch * stride + i
        if near_inout[0].branches[j] == 1:
            child = near_inout[0].branch_ends[j] - 1
            if child >= far[0].weights.shape[0]:
                continue
            if is_lit:
                light = captured_color(far[0].radiance.captured[child], far[0].radiance.captured_weight[child])
                if far[0].radiance.capture_factor:
                    weight = far[0].radiance.captured_weight[child]
                    light = wp.cw_mul(light, straight_factor(far[0].radiance.capture_factor[child], weight))
                if branch == LOBES:
                    light *= scene[0].settings[0].capture_gain
                color += wp.cw_mul(far[0].weights[child], light + far[0].radiance.light[child])
            else:
                color += wp.cw_mul(far[0].weights[child], far[0].radiance.captured[child])
    if is_lit:
        near_inout[0].radiance.light[i] += color
        if near_inout[0].radiance.reflection:
            near_inout[0].radiance.reflection[i] += color
    else:
        near_inout[0].radiance.captured[i] = color
