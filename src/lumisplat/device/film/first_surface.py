"""The first surface on a ray: depth, normal and indices of a frame."""

import warp as wp

from lumisplat.device.mesh.mesh_surface import hit_weights, surface_normal
from lumisplat.device.splat.blending import NORMAL_MIN, instance_of
from lumisplat.device.splat.projection import above_horizon
from lumisplat.device.structs.rays import FirstSurface
from lumisplat.device.structs.shading import ShadingScene, WaveData

wp.set_module_options({"enable_backward": False})


@wp.func
def first_surface(i: int, scene: wp.array[ShadingScene], wave: wp.array[WaveData]) -> FirstSurface:
    """The iso-opacity surface of the Gaussians or, if it is not reached, the mesh behind them; normals blend."""
    surface = FirstSurface()
    surface.depth = wave[0].gaussians.depth[i]
    surface.gaussian = -1
    surface.instance = -1
    if surface.depth < wp.inf and wave[0].gaussians.gaussian[i] >= 0:
        surface.instance = instance_of(scene[0].splats, wave[0].gaussians.gaussian[i])
        surface.gaussian = wave[0].gaussians.gaussian[i] - scene[0].splats[surface.instance].first

    transmittance = wave[0].gaussians.transmittance[i]
    normal = wave[0].gaussians.normal[i]
    weight = 1.0 - transmittance
    face = wave[0].meshes.face[i]
    if face >= 0:
        number = wave[0].meshes.instance[i]
        corners = scene[0].meshes.indices[face]
        mesh_normal = surface_normal(
            scene[0].mesh_instances[number], scene[0].meshes, corners, hit_weights(wave[0].meshes.weights[i])
        )
        if wp.dot(mesh_normal, wave[0].rays.direction[i]) > 0.0:
            mesh_normal = -mesh_normal
        normal += transmittance * mesh_normal
        weight = float(1.0)
        if surface.gaussian < 0:
            surface.depth = wave[0].meshes.t[i]
            surface.instance = scene[0].splats.shape[0] + number

    if weight > 0.0:
        if wp.length(normal) > NORMAL_MIN * weight:
            surface.normal = above_horizon(wp.normalize(normal), -wave[0].rays.direction[i])
        else:
            surface.normal = -wave[0].rays.direction[i]
    return surface
