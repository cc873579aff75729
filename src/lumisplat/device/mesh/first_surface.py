"""From a traced ray to the surface that its pixel shows."""

from typing import Any

import warp as wp

from lumisplat.constants import NORMAL_DEGENERATE
from lumisplat.device.gaussian.compositing import instance_of
from lumisplat.device.mesh.mesh_surface import hit_weights, surface_normal
from lumisplat.device.structs.rays import GaussianHits, RayData, RayMeshHits, RaySurface
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, PixelData

wp.set_module_options({"enable_backward": False})

NORMAL_MIN = wp.constant(wp.float32(NORMAL_DEGENERATE))


@wp.func
def surface_of_ray(
    i: int,
    rays: RayData,
    radiance: GaussianHits,
    hits: RayMeshHits,
    instances: wp.array(dtype=Any),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
) -> RaySurface:
    """The Gaussians' surface where they reach one, that of the mesh behind them otherwise; normals blend.

    ``instances`` are those of the Gaussians, each with the number of its ``first``.
    """
    surface = RaySurface()
    surface.depth = radiance.depth[i]
    surface.gaussian = -1
    surface.instance = -1
    if surface.depth < wp.inf and radiance.gaussian[i] >= 0:
        surface.instance = instance_of(instances, radiance.gaussian[i])
        surface.gaussian = radiance.gaussian[i] - instances[surface.instance].first

    transmittance = radiance.transmittance[i]
    normal = radiance.normal[i]
    weight = 1.0 - transmittance
    face = hits.face[i]
    if face >= 0:
        number = hits.instance[i]
        mesh_normal = surface_normal(mesh_instances[number], meshes, meshes.indices[face], hit_weights(hits.weights[i]))
        if wp.dot(mesh_normal, rays.direction[i]) > 0.0:
            mesh_normal = -mesh_normal
        normal += transmittance * mesh_normal
        weight = float(1.0)
        if surface.gaussian < 0:
            surface.depth = rays.t_max[i]
            surface.instance = instances.shape[0] + number

    if weight > 0.0:
        if wp.length(normal) > NORMAL_MIN * weight:
            surface.normal = wp.normalize(normal)
        else:
            surface.normal = -rays.direction[i]
    return surface


@wp.func
def store_sample(
    i: int,
    sample: int,
    color: wp.vec3,
    alpha: float,
    found: RaySurface,
    surface: PixelData,
    nonfinite: wp.array(dtype=int),
):
    """Sample n moves the means of element ``i`` by 1 / (n + 1) of the way; the first one's surface stays.

    What is not finite is shown black, and counted.
    """
    if not wp.isfinite(color[0] + color[1] + color[2]):
        color = wp.vec3(0.0)
        nonfinite[i] = nonfinite[i] + 1
    if sample == 0:
        surface.color[i] = color
        surface.alpha[i] = alpha
        surface.depth[i] = found.depth
        surface.normal[i] = found.normal
        surface.gaussian[i] = found.gaussian
        surface.instance[i] = found.instance
    else:
        share = 1.0 / float(sample + 1)
        surface.color[i] += share * (color - surface.color[i])
        surface.alpha[i] += share * (alpha - surface.alpha[i])
