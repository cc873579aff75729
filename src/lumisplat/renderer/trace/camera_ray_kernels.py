"""From pixels to rays and back. One item is one ray; rays come in square blocks of pixels.

``start_rays`` writes the rays of one sample, ``store_rays`` what they saw: the running mean of their colours, and
the surface that the first sample met. ``load_rays`` and ``store_hits`` do the same for rays in any order.
"""

import warp as wp

from lumisplat.device.camera.camera import camera_ray
from lumisplat.device.camera.ray_blocks import pixel_of_ray
from lumisplat.device.math.random import pixel_key_of, sample_key_of
from lumisplat.device.mesh.first_surface import store_sample, surface_of_ray
from lumisplat.device.structs.rays import GaussianHits, LensData, RayData, RayMeshHits, RaySurface
from lumisplat.device.structs.scene import InstanceData, MeshData, MeshInstanceData, PixelData

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
    rays_out.path_length[i] = 0.0
    rays_out.sample_key[i] = sample_key_of(y * lens.width + x, lens.sample, lens.seed)
    rays_out.pixel_key[i] = pixel_key_of(y * lens.width + x, lens.seed)
    if wp.length_sq(ray.direction) > 0.0:
        rays_out.t_max[i] = wp.inf


@wp.kernel
def store_rays(
    start: int,
    lenses: wp.array(dtype=LensData),
    background: wp.vec3,
    rays: RayData,
    radiance: GaussianHits,
    hits: RayMeshHits,
    colors: wp.array(dtype=wp.vec3),
    instances: wp.array(dtype=InstanceData),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    surface_inout: PixelData,
    nonfinite_inout: wp.array(dtype=int),
):
    """Over the background where there is no ray."""
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
    surface = RaySurface()
    surface.depth = wp.inf
    surface.gaussian = -1
    surface.instance = -1
    if exists and lens.sample == 0:
        surface = surface_of_ray(i, rays, radiance, hits, instances, mesh_instances, meshes)
    store_sample(pixel, lens.sample, color, alpha, surface, surface_inout, nonfinite_inout)


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
    rays_out.path_length[i] = 0.0
    rays_out.sample_key[i] = sample_key_of(first + i, sample, seed)
    rays_out.pixel_key[i] = pixel_key_of(first + i, seed)


@wp.kernel
def store_hits(
    start: int,
    sample: int,
    lit: bool,
    rays: RayData,
    radiance: GaussianHits,
    hits: RayMeshHits,
    colors: wp.array(dtype=wp.vec3),
    instances: wp.array(dtype=InstanceData),
    mesh_instances: wp.array(dtype=MeshInstanceData),
    meshes: MeshData,
    surface_inout: PixelData,
    nonfinite_inout: wp.array(dtype=int),
):
    """As ``store_rays``, without a background; ``lit`` colours have none."""
    i = start + wp.tid()
    if sample == 0:
        nonfinite_inout[i] = 0
    if not rays.t_max[i] > rays.t_min[i]:
        return
    color = radiance.color[i]
    alpha = 1.0 - radiance.transmittance[i]
    if hits.face[i] >= 0:
        alpha = float(1.0)
    if lit or hits.face[i] >= 0:
        color = colors[i]
    surface = RaySurface()
    if sample == 0:
        surface = surface_of_ray(i, rays, radiance, hits, instances, mesh_instances, meshes)
    store_sample(i, sample, color, alpha, surface, surface_inout, nonfinite_inout)
