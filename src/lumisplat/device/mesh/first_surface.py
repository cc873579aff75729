"""The first surface on a ray, as depth, normal and indices of a frame show it."""

import warp as wp

from lumisplat.constants import NORMAL_DEGENERATE
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_normal
from lumisplat.device.structs.rays import FirstSurface, GaussianHits, MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, SplatInstanceData

wp.set_module_options({"enable_backward": False})

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))


@wp.func
def first_surface(
    i: int,
    rays: RayData,
    meshes: MeshHits,
    gaussians: GaussianHits,
    instances: wp.array(dtype=SplatInstanceData),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    mesh_data: MeshData,
) -> FirstSurface:
    """The Gaussians' surface where they reach one, that of the mesh behind them otherwise; normals blend."""
    surface = FirstSurface()
    surface.depth = gaussians.depth[i]
    surface.gaussian = -1
    surface.instance = -1
    if surface.depth < wp.inf and gaussians.gaussian[i] >= 0:
        surface.instance = instance_of(instances, gaussians.gaussian[i])
        surface.gaussian = gaussians.gaussian[i] - instances[surface.instance].first

    transmittance = gaussians.transmittance[i]
    normal = gaussians.normal[i]
    weight = 1.0 - transmittance
    face = meshes.face[i]
    if face >= 0:
        number = meshes.instance[i]
        corners = mesh_data.indices[face]
        mesh_normal = surface_normal(mesh_instances[number], mesh_data, corners, hit_weights(meshes.weights[i]))
        if wp.dot(mesh_normal, rays.direction[i]) > 0.0:
            mesh_normal = -mesh_normal
        normal += transmittance * mesh_normal
        weight = float(1.0)
        if surface.gaussian < 0:
            surface.depth = meshes.t[i]
            surface.instance = instances.shape[0] + number

    if weight > 0.0:
        if wp.length(normal) > NORMAL_MIN * weight:
            surface.normal = wp.normalize(normal)
        else:
            surface.normal = -rays.direction[i]
    return surface
