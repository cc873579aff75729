"""Pixels of a picture, and where the image of a window of it has them."""

import warp as wp

from lumisplat.device.camera.ray_blocks import pixel_of_ray, ray_of_pixel
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})


@wp.func
def is_shown(camera: CameraData, x: int, y: int) -> bool:
    """Whether a pixel, which is not left of the window or above it, is in it."""
    return x < camera.left + camera.width and y < camera.top + camera.height


@wp.func
def image_index(camera: CameraData, x: int, y: int) -> int:
    """Where the image has a pixel of the picture, row by row."""
    return (y - camera.top) * camera.width + x - camera.left


@wp.func
def ray_index(camera: CameraData, x: int, y: int) -> int:
    """The ray of a pixel of the picture."""
    return ray_of_pixel(camera.width, x - camera.left, y - camera.top)


@wp.func
def shown_pixel(camera: CameraData, index: int) -> wp.vec2i:
    """The pixel of the picture at a place of the image."""
    return wp.vec2i(camera.left + index % camera.width, camera.top + index // camera.width)


@wp.func
def seen_pixel(camera: CameraData, ray: int) -> wp.vec2i:
    """The pixel of the picture that a ray is of; it may lie outside the window, to the right or below."""
    at = pixel_of_ray(camera.width, ray)
    return wp.vec2i(camera.left + at[0], camera.top + at[1])


@wp.func
def picture_index(camera: CameraData, x: int, y: int) -> int:
    """Number of a pixel in the picture, from which its random numbers follow."""
    return y * camera.picture_width + x
