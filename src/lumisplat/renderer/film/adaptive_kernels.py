"""Kernels of adaptive sampling: they choose the pixels that get a ray in a sample. One thread per ray or pixel.

Noisy pixels get rays in more samples. The equations are in docs/method/samples.md#adaptive-sampling.
"""

import warp as wp

from lumisplat.constants import NOISE_SAMPLES_MIN, SAMPLE_RATES, SUBPIXEL_STEPS
from lumisplat.device.camera.pixels import pixel_of_ray
from lumisplat.device.film.samples import relative_variance
from lumisplat.device.structs.camera import FilmData, ListedRays

# No fused multiply-add, as on the host: sample positions must equal those of non-adaptive frames.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

NOISE_RADIUS_PX = 3
"""A pixel's sampling rate follows from the mean noise of the pixels around it, up to this many pixels away along each
axis (7 x 7 pixels).
"""

FIRST = wp.constant(NOISE_SAMPLES_MIN)
RATES = wp.constant(SAMPLE_RATES)
RADIUS = wp.constant(NOISE_RADIUS_PX)
STEP_X = wp.constant(wp.float64(SUBPIXEL_STEPS[0]))
STEP_Y = wp.constant(wp.float64(SUBPIXEL_STEPS[1]))


@wp.func
def samples_before(sample: int, rate: int) -> int:
    """Returns how many of a frame's first ``sample`` samples a pixel takes part in.

    The pixel takes part in the first `NOISE_SAMPLES_MIN` samples, then in ``rate`` of each `SAMPLE_RATES` consecutive
    samples.
    """
    if sample < FIRST:
        return sample
    return FIRST + (sample - FIRST) * rate // RATES


@wp.func
def subpixel(sample: int) -> wp.vec2:
    """Returns the position of a sample within its pixel, 0..1; equal to that of the host function ``subpixel``."""
    n = wp.float64(sample)
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    return wp.vec2(float(wp.mod(half + n * STEP_X, one)), float(wp.mod(half + n * STEP_Y, one)))


@wp.kernel
def mark_rays(start: int, sample: int, width: int, height: int, rates: wp.array[int], is_drawn_out: wp.array[int]):
    """Per ray of the full frame: writes 1 if the ray's pixel gets a ray in sample ``sample``, else 0.

    ``rates`` holds each pixel's sampling rate: its number of samples among each `SAMPLE_RATES` consecutive ones.
    """
    ray = start + wp.tid()
    is_drawn_out[ray] = 0
    pixel = pixel_of_ray(width, ray)
    if pixel[0] < width and pixel[1] < height:
        rate = rates[pixel[1] * width + pixel[0]]
        is_drawn_out[ray] = int(samples_before(sample + 1, rate) > samples_before(sample, rate))


@wp.kernel
def list_rays(
    start: int,
    sample: int,
    jitters: bool,
    width: int,
    rates: wp.array[int],
    is_drawn: wp.array[int],
    ends: wp.array[int],
    listed_out: ListedRays,
):
    """Per ray of the full frame: lists the ray if its pixel takes part in this sample.

    ``is_drawn`` is the output of `mark_rays`, and ``ends`` the inclusive prefix sum of ``is_drawn``.
    """
    ray = start + wp.tid()
    if is_drawn[ray] == 0:
        return
    pixel = pixel_of_ray(width, ray)
    number = samples_before(sample, rates[pixel[1] * width + pixel[0]])
    i = ends[ray] - 1
    listed_out.ray[i] = ray
    listed_out.sample[i] = number
    listed_out.offset[i] = subpixel(wp.where(jitters, number, 0))


@wp.kernel
def measure_noise(start: int, least: float, film: wp.array[FilmData], noise_out: wp.array[float]):
    """Per pixel: writes the variance of one sample's luminance, divided by the squared mean luminance.

    Means below ``least`` count as ``least``.
    """
    pixel = start + wp.tid()
    noise_out[pixel] = relative_variance(pixel, least, film)


@wp.kernel
def average_neighbors(start: int, width: int, height: int, noise: wp.array[float], mean_out: wp.array[float]):
    """Per pixel: writes the mean noise of the square of pixels around it, ignoring values that are not finite."""
    pixel = start + wp.tid()
    x = pixel % width
    y = pixel // width
    total = float(0.0)
    count = int(0)
    for j in range(wp.max(y - RADIUS, 0), wp.min(y + RADIUS + 1, height)):
        for i in range(wp.max(x - RADIUS, 0), wp.min(x + RADIUS + 1, width)):
            value = noise[j * width + i]
            if (i != x or j != y) and wp.isfinite(value):
                total += value
                count += 1
    mean_out[pixel] = total / float(wp.max(count, 1))
