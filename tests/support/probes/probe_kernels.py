"""Kernels that run functions of lumisplat.device for many inputs, for their tests."""

import warp as wp

from lumisplat.device.camera.camera import camera_ray
from lumisplat.device.math.random import branch_key, draw, sample_key_of, sobol_2d
from lumisplat.device.structs.camera import CameraData, SampleData
from lumisplat.device.structs.rays import Ray

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_random(
    pixels: wp.array(dtype=int),
    samples: wp.array(dtype=int),
    seeds: wp.array(dtype=wp.uint32),
    dimensions: wp.array(dtype=wp.uint32),
    sample_keys: wp.array(dtype=wp.uint32),
    branches: wp.array(dtype=wp.uint32),
    draws: wp.array(dtype=float),
):
    """Computes sample keys, the keys of their second branch, and draws."""
    i = wp.tid()
    sample_key = sample_key_of(pixels[i], samples[i], seeds[i])
    sample_keys[i] = sample_key
    branches[i] = branch_key(sample_key, 1)
    draws[i] = draw(sample_key, dimensions[i])


@wp.kernel
def probe_sobol(keys: wp.array(dtype=wp.uint32), samples: wp.array(dtype=int), points: wp.array(dtype=wp.vec2)):
    """Computes points of Sobol sequences."""
    i = wp.tid()
    points[i] = sobol_2d(keys[i], samples[i])


@wp.kernel
def probe_rays(cameras: wp.array(dtype=CameraData), samples: wp.array(dtype=SampleData), rays: wp.array(dtype=Ray)):
    """Computes the rays of all pixels."""
    i = wp.tid()
    camera = cameras[0]
    rays[i] = camera_ray(camera, samples[0], i % camera.width, i // camera.width)
