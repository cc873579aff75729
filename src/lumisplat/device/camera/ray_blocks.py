"""The order of a camera's rays: square blocks of pixels row by row, and row by row within a block."""

import warp as wp

from lumisplat.constants import RAY_BLOCK_PX
from lumisplat.device.structs.camera import CameraData

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(RAY_BLOCK_PX)
BLOCK_RAYS = wp.constant(RAY_BLOCK_PX * RAY_BLOCK_PX)


@wp.func
def pixel_of_ray(width: int, ray: int) -> wp.vec2i:
    """Pixel (x, y) of a ray of an image of that width; it may lie outside the image, to the right or below."""
    blocks_x = (width + BLOCK - 1) // BLOCK
    block = ray // BLOCK_RAYS
    within = ray % BLOCK_RAYS
    return wp.vec2i((block % blocks_x) * BLOCK + within % BLOCK, (block // blocks_x) * BLOCK + within // BLOCK)


@wp.func
def ray_of_pixel(width: int, x: int, y: int) -> int:
    """The ray of a pixel inside the image."""
    blocks_x = (width + BLOCK - 1) // BLOCK
    block = (y // BLOCK) * blocks_x + x // BLOCK
    return block * BLOCK_RAYS + (y % BLOCK) * BLOCK + x % BLOCK


@wp.func
def pixel_number(ray: int, camera: wp.array[CameraData]) -> int:
    """Number of a ray's pixel, row by row; -1: it lies outside the image."""
    at = pixel_of_ray(camera[0].width, ray)
    if at[0] >= camera[0].width or at[1] >= camera[0].height:
        return -1
    return at[1] * camera[0].width + at[0]
