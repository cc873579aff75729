"""The pixels of a camera's rays through Gaussians alone, one ray each. Item = ray."""

import warp as wp

from lumisplat.device.camera.pixels import pixel_of_ray
from lumisplat.device.math.color import over
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.rays import GaussianHits

wp.set_module_options({"enable_backward": False})


@wp.kernel
def show_rays(start: int, width: int, height: int, background: wp.vec3, hits: GaussianHits, pixels_out: PixelData):
    """Colour over the background, and alpha; the other images stay as they are."""
    ray = start + wp.tid()
    at = pixel_of_ray(width, ray)
    if at[0] < width and at[1] < height:
        pixel = at[1] * width + at[0]
        pixels_out.color[pixel] = over(hits.color[ray], hits.transmittance[ray], background)
        pixels_out.alpha[pixel] = 1.0 - hits.transmittance[ray]
