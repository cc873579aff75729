"""Reflection and refraction, wave by wave. One item is one ray, or one branch of a ray.

A ray has two branches, numbered ``ray`` (reflected) and ``stride + ray`` (refracted); most are empty. An inclusive sum
over how many there are in each, 0 or 1, numbers the rays of the next wave. The mirror image comes first in it, then
what is seen through glass, each in the order of the wave before: neighbours stay neighbours.
"""

import warp as wp

from lumisplat.constants import BOUNCE_WEIGHT_MIN
from lumisplat.device.material.fresnel import reflect, refract
from lumisplat.device.material.specular_bounce import bounce_of_ray, spawn_point
from lumisplat.device.math.color import over
from lumisplat.device.math.random import branch_key
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs.rays import GaussianHits, MeshPlacement, RayData, RayMeshHits
from lumisplat.device.structs.scene import CameraData, MeshData, MeshInstanceData

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

WEIGHT_MIN = wp.constant(wp.float32(BOUNCE_WEIGHT_MIN))


@wp.kernel
def scatter_rays(
    start: int,
    may_branch: bool,
    camera: wp.array(dtype=CameraData),
    instances: wp.array(dtype=MeshInstanceData),
    placements: wp.array(dtype=MeshPlacement),
    meshes: MeshData,
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
    path_weights: wp.array(dtype=float),
    color_out: wp.array(dtype=wp.vec3),
    branches_out: wp.array(dtype=int),
):
    """What a ray sees without its branches, and which of these are worth following; others see the background."""
    i = start + wp.tid()
    color = wp.vec3(0.0)
    reflects = int(0)
    refracts = int(0)
    if rays.t_max[i] > rays.t_min[i]:
        transmittance = radiance.transmittance[i]
        color = radiance.color[i]
        if hits.face[i] >= 0:
            bounce = bounce_of_ray(i, rays, hits, instances, placements, meshes, False)
            color += transmittance * bounce.color
            if may_branch:
                weight = transmittance * path_weights[i]
                reflects = int(weight * wp.max(bounce.reflected) >= WEIGHT_MIN)
                refracts = int(weight * wp.max(bounce.refracted) >= WEIGHT_MIN)
            if reflects == 0:
                color += transmittance * wp.cw_mul(bounce.reflected, camera[0].background)
            if refracts == 0:
                color += transmittance * wp.cw_mul(bounce.refracted, camera[0].background)
        else:
            color = over(color, transmittance, camera[0].background)
    color_out[i] = color
    if may_branch:
        branches_out[i] = reflects
        branches_out[branches_out.shape[0] // 2 + i] = refracts


@wp.kernel
def spawn_rays(
    start: int,
    lit: bool,
    instances: wp.array(dtype=MeshInstanceData),
    placements: wp.array(dtype=MeshPlacement),
    meshes: MeshData,
    rays: RayData,
    hits: RayMeshHits,
    radiance: GaussianHits,
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
    bounce = bounce_of_ray(i, rays, hits, instances, placements, meshes, lit)
    weight = radiance.transmittance[i] * bounce.reflected
    direction = reflect(rays.direction[i], bounce.normal)
    side = bounce.side
    if refracted == 1:
        weight = radiance.transmittance[i] * bounce.refracted
        direction = refract(rays.direction[i], bounce.normal, bounce.eta)
        side = -bounce.side
    corners = meshes.indices[hits.face[i]]
    placement = placements[hits.instance[i]]

    child = branch_ends[j] - 1
    rays_out.origin[child] = spawn_point(placement, meshes, corners, hit_weights(hits.weights[i]), side)
    rays_out.direction[child] = direction
    rays_out.t_min[child] = 0.0
    rays_out.t_max[child] = wp.inf
    rays_out.path_length[child] = rays.path_length[i] + rays.t_max[i]
    rays_out.sample_key[child] = branch_key(rays.sample_key[i], refracted)
    rays_out.pixel_key[child] = branch_key(rays.pixel_key[i], refracted)
    weights_out[child] = weight
    path_weights_out[child] = path_weights[i] * wp.max(weight)


@wp.kernel
def gather_branches(
    start: int,
    branches: wp.array(dtype=int),
    branch_ends: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
    colors: wp.array(dtype=wp.vec3),
    color_inout: wp.array(dtype=wp.vec3),
):
    """Adds what a ray's branches see to what it sees itself."""
    i = start + wp.tid()
    stride = branches.shape[0] // 2
    color = color_inout[i]
    for branch in range(2):
        j = branch * stride + i
        if branches[j] == 1:
            child = branch_ends[j] - 1
            color += wp.cw_mul(weights[child], colors[child])
    color_inout[i] = color
