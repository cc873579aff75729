"""From pixels to rays and back. One item is one ray; rays come in square blocks of pixels.

``start_rays`` writes the rays of one sample, ``store_rays`` what they saw: the running mean of their colours, and
the surface that the first sample met. ``load_rays`` and ``store_hits`` do the same for rays in any order.
"""

import warp as wp

from lumisplat.device.random import stream_of
from lumisplat.device.ray_blocks import pixel_of_ray
from lumisplat.device.ray_structs import LensData, RayData, RayMeshHits, RayRadiance
from lumisplat.device.ray_surface import surface_of_ray
from lumisplat.device.rays import camera_ray
from lumisplat.device.structs import MeshData, MeshInstanceData, SurfaceData
from lumisplat.device.trace_structs import TreeInstance

wp.set_module_options({"enable_backward": False})


@wp.kernel
def start_rays(start: int, lenses: wp.array(dtype=LensData), rays_out: RayData):
    """Rays beyond the image, and where a fisheye sees nothing, are none."""
    i = start + wp.tid()
    lens = lenses[0]
    pixel = pixel_of_ray(lens.width, i)
    x = pixel[0]
    y = pixel[1]
    rays_out.t_max[i] = -wp.inf
    if x >= lens.width or y >= lens.height:
        return
    ray = camera_ray(lens, x, y)
    rays_out.origin[i] = ray.origin
    rays_out.direction[i] = ray.direction
    rays_out.t_min[i] = ray.t_min
    rays_out.travelled[i] = 0.0
    rays_out.stream[i] = stream_of(y * lens.width + x, lens.sample, lens.seed)
    if wp.length_sq(ray.direction) > 0.0:
        rays_out.t_max[i] = wp.inf


@wp.kernel
def store_rays(
    start: int,
    lenses: wp.array(dtype=LensData),
    background: wp.vec3,
    rays: RayData,
    radiance: RayRadiance,
    hits: RayMeshHits,
    colors: wp.array(dtype=wp.vec3),
    instances: wp.array(dtype=TreeInstance),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    surface_inout: SurfaceData,
    nonfinite_inout: wp.array(dtype=int),
):
    """Sample n moves the mean by 1 / (n + 1) of the way. What is not finite is shown black, and counted."""
    i = start + wp.tid()
    lens = lenses[0]
    position = pixel_of_ray(lens.width, i)
    if position[0] >= lens.width or position[1] >= lens.height:
        return
    pixel = position[1] * lens.width + position[0]
    color = background
    alpha = float(0.0)
    exists = rays.t_max[i] > rays.t_min[i]
    if exists:
        color = colors[i]
        alpha = wp.where(hits.face[i] >= 0, 1.0, 1.0 - radiance.transmittance[i])
    if not wp.isfinite(color[0] + color[1] + color[2]):
        color = wp.vec3(0.0)
        nonfinite_inout[pixel] = nonfinite_inout[pixel] + 1
    if lens.sample == 0:
        surface_inout.color[pixel] = color
        surface_inout.alpha[pixel] = alpha
        surface_inout.depth[pixel] = wp.inf
        surface_inout.normal[pixel] = wp.vec3(0.0)
        surface_inout.gaussian[pixel] = -1
        surface_inout.instance[pixel] = -1
        if exists:
            surface = surface_of_ray(i, rays, radiance, hits, instances, mesh_instances, meshes)
            surface_inout.depth[pixel] = surface.depth
            surface_inout.normal[pixel] = surface.normal
            surface_inout.gaussian[pixel] = surface.gaussian
            surface_inout.instance[pixel] = surface.instance
    else:
        share = 1.0 / float(lens.sample + 1)
        surface_inout.color[pixel] += share * (color - surface_inout.color[pixel])
        surface_inout.alpha[pixel] += share * (alpha - surface_inout.alpha[pixel])


@wp.kernel
def load_rays(
    start: int,
    first: int,
    count: int,
    sample: int,
    seed: wp.uint32,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    distances: wp.array(dtype=float),
    rays_out: RayData,
):
    """``count`` rays, the rest are none. ``first`` is the number of the first one among all that were asked for."""
    i = start + wp.tid()
    rays_out.t_max[i] = -wp.inf
    if i >= count:
        return
    rays_out.origin[i] = origins[i]
    rays_out.direction[i] = directions[i]
    rays_out.t_min[i] = 0.0
    rays_out.t_max[i] = distances[i]
    rays_out.travelled[i] = 0.0
    rays_out.stream[i] = stream_of(first + i, sample, seed)


@wp.kernel
def store_hits(
    start: int,
    sample: int,
    rays: RayData,
    radiance: RayRadiance,
    hits: RayMeshHits,
    colors: wp.array(dtype=wp.vec3),
    instances: wp.array(dtype=TreeInstance),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    surface_inout: SurfaceData,
    nonfinite_inout: wp.array(dtype=int),
):
    """As ``store_rays``, without a background."""
    i = start + wp.tid()
    if sample == 0:
        nonfinite_inout[i] = 0
    if not rays.t_max[i] > rays.t_min[i]:
        return
    color = radiance.color[i]
    alpha = 1.0 - radiance.transmittance[i]
    if hits.face[i] >= 0:
        color = colors[i]
        alpha = float(1.0)
    if not wp.isfinite(color[0] + color[1] + color[2]):
        color = wp.vec3(0.0)
        nonfinite_inout[i] = nonfinite_inout[i] + 1
    if sample == 0:
        surface = surface_of_ray(i, rays, radiance, hits, instances, mesh_instances, meshes)
        surface_inout.color[i] = color
        surface_inout.alpha[i] = alpha
        surface_inout.depth[i] = surface.depth
        surface_inout.normal[i] = surface.normal
        surface_inout.gaussian[i] = surface.gaussian
        surface_inout.instance[i] = surface.instance
    else:
        share = 1.0 / float(sample + 1)
        surface_inout.color[i] += share * (color - surface_inout.color[i])
        surface_inout.alpha[i] += share * (alpha - surface_inout.alpha[i])
