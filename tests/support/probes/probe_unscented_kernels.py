"""Kernels that compute moments of projected Gaussians, for tests."""

import warp as wp

from lumisplat.device.camera.camera import pixel_at_row_time
from lumisplat.device.splat.ray_bounds import ImageMoments, WorldGaussian, projected_moments
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_moments(
    field: float,
    camera: wp.array(dtype=CameraData),
    gaussians: wp.array(dtype=WorldGaussian),
    moments_out: wp.array(dtype=ImageMoments),
):
    """Computes the image moments of Gaussians."""
    i = wp.tid()
    moments_out[i] = projected_moments(camera[0], field, gaussians[i])


@wp.kernel
def probe_points(
    field: float,
    camera: wp.array(dtype=CameraData),
    points: wp.array(dtype=wp.vec3),
    pixels_out: wp.array(dtype=wp.vec3),
):
    """Projects points to pixels, at the exposure times of their rows."""
    i = wp.tid()
    pixels_out[i] = pixel_at_row_time(camera[0], field, points[i])
