"""Kernels that start the rays of a sample. One thread per ray; camera rays are stored in square blocks of pixels."""

import warp as wp

from lumisplat.device.camera.camera import camera_ray
from lumisplat.device.camera.pinhole_lanes import (
    LANES,
    PinholeStorage,
    is_plain_pinhole,
    pinhole_lanes,
    start_lanes,
)
from lumisplat.device.camera.pixels import full_image_index, full_pixel_of_ray, is_in_window
from lumisplat.device.math.random import pixel_key_of, sample_key_of
from lumisplat.device.structs.camera import CameraData, ListedRays, SampleData
from lumisplat.device.structs.rays import RayData

wp.set_module_options({"enable_backward": False})


@wp.func
def start_ray(i: int, camera: CameraData, sample: SampleData, listed: ListedRays, rays_out: RayData):
    """Starts ray ``i``; arguments as for ``start_rays``."""
    pixel_index = i
    rays_out.is_active[i] = False
    if listed.ray:
        pixel_index = listed.ray[i]
        if pixel_index < 0:
            return
        sample.index = listed.sample[i]
        camera.offset = listed.offset[i]
    pixel = full_pixel_of_ray(camera, pixel_index)
    x = pixel[0]
    y = pixel[1]
    if not is_in_window(camera, x, y):
        return
    ray = camera_ray(camera, sample, x, y)
    rays_out.is_active[i] = wp.length_sq(ray.direction) > 0.0
    rays_out.origin[i] = ray.origin
    rays_out.direction[i] = ray.direction
    rays_out.t_min[i] = ray.t_min
    rays_out.normal[i] = wp.vec3(0.0)
    rays_out.t_max[i] = wp.inf
    rays_out.path_length[i] = 0.0
    rays_out.spread[i] = ray.spread
    number = full_image_index(camera, x, y)
    rays_out.sample_key[i] = sample_key_of(number, sample.index, sample.seed)
    rays_out.pixel_key[i] = pixel_key_of(number, sample.seed)
    rays_out.sample[i] = sample.index


@wp.kernel
def start_rays(
    start: int,
    cameras: wp.array[CameraData],
    samples: wp.array[SampleData],
    listed: ListedRays,
    rays_out: RayData,
):
    """Per ray: starts the ray of a camera's pixel, or of an entry of ``listed`` if the list is not empty.

    Rays outside the window, after the end of the list, or outside a fisheye's image circle are inactive.
    """
    start_ray(start + wp.tid(), cameras[0], samples[0], listed, rays_out)


@wp.kernel
def load_rays(
    start: int,
    first: int,
    count: int,
    samples: wp.array[SampleData],
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    ends: wp.array[float],
    starts: wp.array[float],
    rays_out: RayData,
):
    """Writes a caller's ``count`` rays to the tracer's arrays; further elements of ``rays_out`` are inactive.

    ``first`` is the index, within the caller's query, of the first ray.
    """
    i = start + wp.tid()
    rays_out.is_active[i] = False
    if i >= count:
        return
    sample = samples[0]
    rays_out.is_active[i] = ends[i] > 0.0
    rays_out.origin[i] = origins[i]
    rays_out.direction[i] = directions[i]
    rays_out.t_min[i] = starts[i]
    rays_out.normal[i] = wp.vec3(0.0)
    rays_out.t_max[i] = ends[i]
    rays_out.path_length[i] = 0.0
    rays_out.spread[i] = 0.0
    rays_out.sample_key[i] = sample_key_of(first + i, sample.index, sample.seed)
    rays_out.pixel_key[i] = pixel_key_of(first + i, sample.seed)
    rays_out.sample[i] = sample.index


BY_LANES = wp.get_module(f"{__name__}.lanes")
# The loop over lanes must stay a loop for the vectoriser.
wp.set_module_options({"enable_backward": False, "max_unroll": 4}, BY_LANES)


@wp.kernel(module=BY_LANES)
def start_rays_lanes(
    start: int,
    cameras: wp.array[CameraData],
    samples: wp.array[SampleData],
    listed: ListedRays,
    rays_out: RayData,
):
    """Per 16 rays: starts the rays that ``start_rays`` starts."""
    first = LANES * (start + wp.tid())
    camera = cameras[0]
    sample = samples[0]
    if listed.ray or not is_plain_pinhole(camera):
        for i in range(first, wp.min(first + LANES, rays_out.t_max.shape[0])):
            start_ray(i, camera, sample, listed, rays_out)
        return
    storage = PinholeStorage()
    lanes = pinhole_lanes(storage)
    corner = full_pixel_of_ray(camera, first)
    start_lanes(camera, sample, corner[0], corner[1], lanes)
    for lane in range(LANES):
        i = first + lane
        at = full_pixel_of_ray(camera, i)
        rays_out.is_active[i] = is_in_window(camera, at[0], at[1])
        rays_out.origin[i] = camera.eye
        rays_out.direction[i] = wp.vec3(lanes.direction[0, lane], lanes.direction[1, lane], lanes.direction[2, lane])
        rays_out.t_min[i] = lanes.t_min[lane]
        rays_out.normal[i] = wp.vec3(0.0)
        rays_out.t_max[i] = wp.inf
        rays_out.path_length[i] = 0.0
        rays_out.spread[i] = lanes.spread[lane]
        rays_out.sample_key[i] = lanes.sample_key[lane]
        rays_out.pixel_key[i] = lanes.pixel_key[lane]
        rays_out.sample[i] = sample.index
