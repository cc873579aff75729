"""Kernels that apply an image's exposure to a frame, and return gradients with respect to frame and exposure.

Exposures change the Gaussians' colours and leave the background as is. The equations are in
docs/method/training.md#exposures.
"""

import warp as wp

from lumisplat.constants import EXPOSURE_CHUNK, FUSED_FLAGS
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.training import Exposure

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FUSED_FLAGS})

CHUNK = wp.constant(EXPOSURE_CHUNK)


@wp.func
def gaussian_color(pixels: PixelData, exposure: Exposure, i: int) -> wp.vec3:
    """Returns the premultiplied colour that the Gaussians add to a pixel, without the background."""
    return pixels.color[i] - (1.0 - pixels.alpha[i]) * exposure.background


@wp.kernel
def expose(start: int, exposures: wp.array[Exposure], pixels: PixelData, color_out: wp.array[wp.vec3]):
    """Applies the exposure to the Gaussians' colour and adds the unchanged background. One thread per pixel."""
    i = start + wp.tid()
    exposure = exposures[0]
    alpha = pixels.alpha[i]
    exposed = exposure.matrix * gaussian_color(pixels, exposure, i) + alpha * exposure.offset
    color_out[i] = exposed + (1.0 - alpha) * exposure.background


@wp.kernel
def differentiate_chunks(
    start: int,
    exposures: wp.array[Exposure],
    pixels: PixelData,
    by_exposed: PixelGradient,
    by_pixels_out: PixelGradient,
    by_matrix_out: wp.array[wp.mat33],
    by_offset_out: wp.array[wp.vec3],
):
    """Writes the gradient of each pixel before exposure, and a chunk's sum for the exposure. One thread per chunk."""
    chunk = start + wp.tid()
    exposure = exposures[0]
    by_matrix = wp.mat33(0.0)
    by_offset = wp.vec3(0.0)
    from_exposed = wp.transpose(exposure.matrix)
    of_alpha = exposure.matrix * exposure.background + exposure.offset - exposure.background
    for i in range(chunk * CHUNK, wp.min((chunk + 1) * CHUNK, pixels.alpha.shape[0])):
        g = by_exposed.color[i]
        by_matrix += wp.outer(g, gaussian_color(pixels, exposure, i))
        by_offset += pixels.alpha[i] * g
        by_pixels_out.color[i] = from_exposed * g
        by_pixels_out.alpha[i] = by_exposed.alpha[i] + wp.dot(g, of_alpha)
    by_matrix_out[chunk] = by_matrix
    by_offset_out[chunk] = by_offset
