"""Kernels that encode unlit and lit frames to 8 bits, and that store the colours of rays through Gaussians.

Each kernel has its own Warp module, because modules are compiled as a whole: a frame compiles only the kernel it runs.
"""

import warp as wp

from lumisplat.device.camera.pixels import pixel_of_ray
from lumisplat.device.film.tone_map import channels_finite, lit_color, packed_rgba, straightened
from lumisplat.device.math.color import over
from lumisplat.device.structs.camera import LitPixels, PixelData, ToneMapData
from lumisplat.device.structs.rays import GaussianHits

# No fused multiply-add, as on the host, so that the bytes are equal.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

LIT = wp.get_module(f"{__name__}.lit")
wp.set_module_options({"enable_backward": False}, LIT)
RAYS = wp.get_module(f"{__name__}.rays")
wp.set_module_options({"enable_backward": False}, RAYS)


@wp.kernel
def encode_pixels(start: int, straight: bool, pixels: PixelData, picture_out: wp.array[wp.uint32]):
    """Per pixel: packs red, green, blue and alpha into one word; sets the last word to 1 if a pixel is not finite.

    If ``straight``, colours are divided by alpha.
    """
    i = start + wp.tid()
    color = pixels.color[i]
    alpha = pixels.alpha[i]
    if not (channels_finite(color) and wp.isfinite(alpha)):
        picture_out[picture_out.shape[0] - 1] = wp.uint32(1)  # all threads write the same value
        return
    if straight:
        color = straightened(color, alpha)
    picture_out[i] = packed_rgba(color, alpha)


@wp.kernel(module=LIT)
def encode_lit_pixels(
    start: int, picture: ToneMapData, pixels: PixelData, lit: LitPixels, picture_out: wp.array[wp.uint32]
):
    """Per pixel: exposes and tone-maps a pixel of a lit frame, and packs it in the format of `encode_pixels`."""
    i = start + wp.tid()
    captured = pixels.color[i]
    alpha = pixels.alpha[i]
    weight = lit.captured_weight[i]
    light = lit.light[i]
    finite = channels_finite(captured) and channels_finite(light) and channels_finite(lit.color[i])
    if not (finite and wp.isfinite(alpha) and wp.isfinite(weight)):
        picture_out[picture_out.shape[0] - 1] = wp.uint32(1)  # all threads write the same value
        return
    if picture.straight != 0:
        captured = straightened(captured, alpha)
        light = straightened(light, alpha)
        weight = straightened(wp.vec3(weight), alpha)[0]
    picture_out[i] = packed_rgba(lit_color(captured, weight, light, picture), alpha)


@wp.kernel(module=RAYS)
def store_ray_colors(
    start: int, width: int, height: int, background: wp.vec3, hits: GaussianHits, pixels_out: PixelData
):
    """Per ray: writes the ray's colour over the background, and the ray's alpha, to its pixel.

    Other images are unchanged.
    """
    ray = start + wp.tid()
    at = pixel_of_ray(width, ray)
    if at[0] < width and at[1] < height:
        pixel = at[1] * width + at[0]
        pixels_out.color[pixel] = over(hits.color[ray], hits.transmittance[ray], background)
        pixels_out.alpha[pixel] = 1.0 - hits.transmittance[ray]
